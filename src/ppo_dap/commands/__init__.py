"""What each command does with its parsed options: one call of a public function, and its result in words or JSON."""
