"""What `test_hot_paths.py` counts the instructions of: it stops before and after each path."""

import ctypes
import gc
import os
import signal
import sys

import numpy as np

from misstep.bench.contenders import misstep_itself
from misstep.bench.problems import draw_path
from misstep.mixture import em


def em_pass(d, K):
    """One pass over one block of samples, from where Python's own part ends."""
    rng = np.random.default_rng(0)
    X = rng.normal(size=(em.BLOCK, d))
    samples = em.in_blocks(X, np.ones(len(X)))
    room = em.Moments.room_for(1, K, d), em.Work.room_for(K, d)
    rule = em.Rule(0.0, 0.0, 0)

    def start():
        return em.Mixture(np.full(K, 1.0 / K), X[:K].copy(), np.array([np.eye(d)] * K))

    em.iterate(samples, start(), *room, 0, 1, float(len(X)), rule)
    [compiled] = em.iterate.overloads.values()
    arguments = (samples, start(), *room, 0, 1, float(len(X)), rule)
    compiled.entry_point(*arguments)
    return lambda: compiled.entry_point(*arguments)


def query(d):
    """One action of a donut policy, as a control loop asks for it."""
    path = draw_path(4, d, 100)
    policy = misstep_itself.querier(path.mixture, path.states.shape[1], path.scale, 2.0, 2.0)
    for state in path.states[:50]:
        policy(state, None)
    return lambda: policy(path.states[50], None)


PATHS = {
    "EM, two columns": lambda: em_pass(2, K=4),
    "EM, five columns": lambda: em_pass(5, K=2),
    "query, one action": lambda: query(2),
    "query, two actions": lambda: query(14),
}

if __name__ == "__main__":
    made = [make() for make in PATHS.values()]
    process, kill, stop = os.getpid(), os.kill, signal.SIGSTOP
    ctypes.CDLL(None).ptrace(0, 0, None, None)  # PTRACE_TRACEME
    gc.disable()
    kill(process, stop)
    for run in made:
        run()
        kill(process, stop)
    sys.exit()
