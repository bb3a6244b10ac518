"""Everyone who is measured, each behind the same few functions.

This package is run as a program of its own (``python -m contenders``) in whatever environment holds
a contender's library, so it imports no library before it is measured, and nothing of misstep but
where misstep itself is. A module offers those of these functions that its library can do:

========================================  =======================================================
fit(X, weights, means, covariances, n)    n iterations of EM from that start; the model
parameters(model)                         its weights (K,), means (K, d), covariances (K, d, d)
log_likelihood(model, X)                  the sum over all samples, the library's own way
fit_all(X, starts, n)                     the same from many starts, where they can share work;
                                          each one's model and log-likelihood
scan(X, most, seed)                       K of 1 … most by minimum BIC, all else by default
querier(mixture, n, scale, k, reach)      a function: state (n,), previous action (m,) → mode (m,)
========================================  =======================================================
"""
