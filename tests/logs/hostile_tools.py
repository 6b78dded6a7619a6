"""Tools for damaged and hostile logs: a registry of makers, and ways to damage a file.

`MAKERS[kind](folder, rng)` returns the path to load. A kind whose name ends in `_loose` may load as other values: its
maker wrote others, or its layout has no checksum, so that nobody could tell. All others must be refused, be warned
about, or load exactly.
"""

MAKERS = {}
ABSURD = (10**15, 2**62, 2**63 - 1, 2**31, 10**9)


class Payload:
    """Makes its canary when it is unpickled."""

    def __init__(self, canary):
        self.canary = canary

    def __reduce__(self):
        return open, (str(self.canary), "w")


def maker(function):
    MAKERS[function.__name__] = function
    return function


def pick(rng, options):
    return options[rng.integers(len(options))]


def cut(path, rng):
    content = path.read_bytes()
    path.write_bytes(content[: rng.integers(len(content))])
    return path


def flip(path, rng, spared=(), most=6):
    """Change a few bytes, but none within the spared (start, stop)."""
    content = bytearray(path.read_bytes())
    places = [p for p in range(len(content)) if not any(start <= p < stop for start, stop in spared)]
    for place in rng.choice(places, size=rng.integers(1, most + 1)):
        content[place] ^= 1 << rng.integers(8)
    path.write_bytes(content)
    return path
