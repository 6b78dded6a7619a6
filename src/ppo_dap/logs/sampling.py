"""Rows that come in pieces, kept within a budget of bytes: all of them, or episodes drawn uniformly by seed."""

import heapq
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from ppo_dap.errors import InputError

MAX_BYTES = 2**28
"""Default budget: about 3 million rows of 20 numbers, which is as many rows as Stage I draws (`max_steps` times
`batch_size`); fitting then takes under 2 GiB in all."""
GROUP_BYTES = 2**16  # neighbouring shorter episodes are drawn together: one by one they would cost more than their rows
PARTS = 16  # a block is at most this part of the budget

Rows = dict[str, Shaped[np.ndarray, "..."]]
"""Arrays of the same rows, by name; `episode_ends` is among them."""


class Budget(NamedTuple):
    """What may be kept of a source: at most `max_bytes` in memory; `seed` draws the episodes where that is not all."""

    max_bytes: int = MAX_BYTES
    seed: int = 0


class Block(NamedTuple):
    """Consecutive rows that are kept or dropped together."""

    key: float
    """Its place in the random order; negative, so that a heap yields the last one."""
    number: int
    """Its place in the source."""
    rows: Rows


class EpisodeSample:
    """Whole episodes of a stream of rows, as many as the budget holds, each equally likely to be there.

    The rows are cut in blocks: one episode, or a few neighbouring short ones, or a stretch of one that is longer than
    1/16 of the budget. Each block draws a place in a random order by the seed; those first in the order are kept, up
    to the budget. One pass, and never more than the budget and a piece in memory.
    """

    def __init__(self, budget: Budget):
        if not (isinstance(budget.max_bytes, int) and budget.max_bytes > 0):
            raise InputError(f"max_bytes is {budget.max_bytes!r}: must be a whole number of bytes above 0")
        if not (isinstance(budget.seed, int) and budget.seed >= 0):
            raise InputError(f"seed is {budget.seed!r}: must be a whole number of 0 or more")
        self.budget = budget
        self.of_rows = self.of_episodes = 0
        self._rng = np.random.default_rng(budget.seed)
        self._kept: list[Block] = []
        self._kept_bytes = 0
        self._limit = np.inf  # keys from here on are out: something before them in the order was already too much
        self._number = 0
        self._open: list[Rows] = []
        self._open_rows = 0
        self._key = self._rng.random()

    def add(self, rows: Rows) -> None:
        """The next rows of the source; they are copied where they are kept."""
        count = len(rows["episode_ends"])
        stops = np.flatnonzero(rows["episode_ends"]) + 1
        self.of_rows, self.of_episodes = self.of_rows + count, self.of_episodes + len(stops)
        row_bytes = max(sum(array.nbytes for array in rows.values()) // max(count, 1), 1)
        most = max(self.budget.max_bytes // PARTS // row_bytes, 1)
        least = min(GROUP_BYTES // row_bytes, most)
        start = 0
        while start < count:
            # The first episode end with enough rows before it, unless the block grows too long until there.
            wanted = np.searchsorted(stops, start + max(least - self._open_rows, 1))
            stop = int(min(stops[wanted] if wanted < len(stops) else count + 1, start + most - self._open_rows))
            closes = stop <= count
            stop = min(stop, count)
            if self._key < self._limit:
                self._open.append({name: array[start:stop].copy() for name, array in rows.items()})
            self._open_rows += stop - start
            start = stop
            if closes:
                self._close()

    def _close(self) -> None:
        if self._key < self._limit:
            block = Block(-self._key, self._number, _joined(self._open))
            heapq.heappush(self._kept, block)
            self._kept_bytes += _size(block)
            while self._kept_bytes > self.budget.max_bytes:
                dropped = heapq.heappop(self._kept)
                self._limit = -dropped.key
                self._kept_bytes -= _size(dropped)
        self._number += 1
        self._key = self._rng.random()
        self._open, self._open_rows = [], 0

    def result(self) -> tuple[dict[str, Any], dict[str, int] | None]:
        """The kept rows in the source's order, and how many of how many they are (None: all). Ends the sample.

        A stretch ends an episode where the rows that follow it are not kept. Raises `InputError` when the budget does
        not hold a single block.
        """
        if self._open_rows:
            self._close()
        if not self._kept:
            raise InputError(f"max_bytes is {self.budget.max_bytes}: must hold a few rows")
        blocks = sorted(self._kept, key=lambda block: block.number)
        for block, following in zip(blocks, [*blocks[1:], None], strict=True):
            if following is None or following.number != block.number + 1:
                block.rows["episode_ends"][-1] = True
        self._kept = []
        # Field by field, so that the blocks and the whole are never both there.
        rows = {name: np.concatenate([block.rows.pop(name) for block in blocks]) for name in list(blocks[0].rows)}
        drawn = {
            "rows": len(rows["episode_ends"]),
            "of_rows": self.of_rows,
            "episodes": int(rows["episode_ends"].sum()),
            "of_episodes": self.of_episodes,
            **self.budget._asdict(),
        }
        return rows, drawn if drawn["rows"] < self.of_rows else None


def _joined(parts: list[Rows]) -> Rows:
    return parts[0] if len(parts) == 1 else {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _size(block: Block) -> int:
    return sum(array.nbytes for array in block.rows.values())
