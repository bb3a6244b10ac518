"""Where each attempt went wrong: point of no return, disagreement, departure, and the words.

>>> from misstep.blame import find_blame
>>> from misstep.demonstrators import demonstrate
>>> from misstep.systems import make_system
>>> shown = demonstrate(make_system("cartpole"), by="reversed", n=4)
>>> find_blame(shown)[1].fault.words
'the force pushed the wrong way'
"""

from misstep.blame.actions import ActionLimits, action_limits
from misstep.blame.blame import Blame, find_blame, sentences
from misstep.blame.boundary import Boundary
from misstep.blame.faults import Fault, FaultKind
from misstep.blame.recovery import Recovery

__all__ = [
    "ActionLimits",
    "Blame",
    "Boundary",
    "Fault",
    "FaultKind",
    "Recovery",
    "action_limits",
    "find_blame",
    "sentences",
]
