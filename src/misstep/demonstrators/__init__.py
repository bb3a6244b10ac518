"""Ways to fail: demonstrators that cannot do the task, each in a way of its own.

>>> from misstep.demonstrators import demonstrate
>>> from misstep.systems import make_system
>>> len(demonstrate(make_system("flipup"), by="bracket", n=4))
4
"""

from misstep.demonstrators.balancing import BangBang, Delayed, Noisy, Random, Reversed, Weak
from misstep.demonstrators.recording import (
    DEMONSTRATORS,
    Demonstrator,
    demonstrate,
    list_demonstrators,
)
from misstep.demonstrators.striking import Bracket, Lopsided, Strong, Timid

__all__ = [
    "DEMONSTRATORS",
    "BangBang",
    "Bracket",
    "Delayed",
    "Demonstrator",
    "Lopsided",
    "Noisy",
    "Random",
    "Reversed",
    "Strong",
    "Timid",
    "Weak",
    "demonstrate",
    "list_demonstrators",
]
