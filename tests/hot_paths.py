"""What `test_hot_paths.py` counts the instructions of: it stops before and after each path."""

import ctypes
import gc
import os
import signal
import sys

import numpy as np

from misstep.bench.contenders import misstep_itself
from misstep.mixture import em


def em_pass(d, K):
    """One pass over one block of samples, from where Python's own part ends."""
    rng = np.random.default_rng(0)
    X = rng.normal(size=(em.BLOCK, d))
    samples = em.in_blocks(X, np.ones(len(X)))
    room = em.Moments.room_for(1, K, d), em.Work.room_for(K, d)
    rule = em.Rule(np.zeros(d), 0.0, 0)

    def start():
        return em.Mixture(np.full(K, 1.0 / K), X[:K].copy(), np.array([np.eye(d)] * K))

    em.iterate(samples, start(), *room, 0, 1, float(len(X)), rule)
    [compiled] = em.iterate.overloads.values()
    arguments = (samples, start(), *room, 0, 1, float(len(X)), rule)
    compiled.entry_point(*arguments)
    return lambda: compiled.entry_point(*arguments)


def query(n, m, K=4):
    """One action of a donut policy, as a control loop asks for it.

    The mixture is written down in fractions: what a library computes of random numbers differs
    between processors in its last bits, and a climb may then take another step.
    """
    d = n + m
    k, i, j = np.ogrid[:K, :d, :d]
    covariances = 0.5 / (1.0 + (i - j) ** 2 + (k + i * j) % 3) + np.where(i == j, 1.0 + k % 2, 0.0)
    covariances = 0.5 * (covariances + covariances.transpose(0, 2, 1))
    means = ((7.0 * np.arange(K)[:, None] + 5.0 * np.arange(d)) % 11.0 - 5.0) / 4.0
    mixture = np.array([0.125, 0.25, 0.375, 0.25]), means, covariances
    policy = misstep_itself.querier(mixture, n, np.full(m, 0.5), 2.0, 2.0)
    states = means[0, :n] + (means[1, :n] - means[0, :n]) * np.arange(64)[:, None] / 64.0
    for state in states[:32]:
        policy(state, None)
    return lambda: policy(states[32], None)


PATHS = {
    "EM, two columns": lambda: em_pass(2, K=4),
    "EM, five columns": lambda: em_pass(5, K=2),
    "query, one action": lambda: query(1, 1),
    "query, two actions": lambda: query(12, 2),
    "query, seven actions": lambda: query(7, 7),
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
