"""How far guidance can be trusted (5.7), and the bound as a lens (4.8): of one run, from its checkpoint."""
