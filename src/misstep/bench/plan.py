"""How much is measured: all of it in a quarter of an hour, or a quick look in a minute or two."""

from dataclasses import dataclass

Size = tuple[int, int]
"""Samples and columns."""


@dataclass(frozen=True)
class Plan:
    """What a bench measures."""

    em_sizes: tuple[Size, ...]
    """One fit from a given start."""
    scan_sizes: tuple[Size, ...]
    """K = 1 … 10 from given starts, and again with defaults."""
    query_components: tuple[int, ...]
    query_columns: tuple[int, ...]
    threads: tuple[int, ...]
    em_components: int
    em_iterations: int
    scan_iterations: int
    queries: int
    slow_queries: int
    """Of contenders other than misstep."""
    repeats: int
    limit: float
    """Seconds after which a measurement is given up."""
    slow_samples: int
    """Scans of more samples are left to misstep and scikit-learn."""
    mixtures: dict[str, int]
    """Random mixtures that each contender scans for the right K."""
    growth: dict[str, tuple[int, ...]]
    """Samples, components and columns along which the cost of a fit is followed."""
    memory_size: Size
    paper: bool

    most_components: int = 10


FULL = Plan(
    em_sizes=tuple((n, d) for d in (2, 5, 14) for n in (6_000, 30_000, 200_000)),
    scan_sizes=((6_000, 2), (30_000, 2), (200_000, 2), (6_000, 5), (6_000, 14), (30_000, 5)),
    query_components=(4, 10),
    query_columns=(2, 5, 14),
    threads=(1, 2),
    em_components=5,
    em_iterations=10,
    scan_iterations=50,
    queries=5_000,
    slow_queries=300,
    repeats=5,
    limit=120.0,
    slow_samples=6_000,
    mixtures={"misstep": 200, "scikit-learn": 40, "gmr": 15, "PyPR": 15, "pomegranate": 15},
    growth={
        "n": (2_000, 8_000, 32_000, 128_000),
        "k": (2, 4, 8, 16, 32),
        "d": (2, 4, 8, 16),
    },
    memory_size=(200_000, 14),
    paper=True,
)

QUICK = Plan(
    em_sizes=((6_000, 2), (6_000, 14)),
    scan_sizes=((6_000, 2),),
    query_components=(4, 10),
    query_columns=(2, 5),
    threads=(1, 2),
    em_components=5,
    em_iterations=10,
    scan_iterations=50,
    queries=1_000,
    slow_queries=50,
    repeats=3,
    limit=30.0,
    slow_samples=0,
    mixtures={"misstep": 20, "scikit-learn": 5, "gmr": 0, "PyPR": 0, "pomegranate": 0},
    growth={"n": (2_000, 8_000, 32_000), "k": (2, 4, 8), "d": (2, 4, 8)},
    memory_size=(30_000, 5),
    paper=False,
)
