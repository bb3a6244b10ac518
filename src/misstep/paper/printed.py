"""The numbers that the paper prints, as printed.

A. R. Khalid, *Learning from Failed Demonstrations*, tables I and II: the cost C = (1/T) Σ |θ| in
degrees, over the first 30 s, 15 s and 7.5 s. One row a trajectory.
"""

import numpy as np

TABLE_1 = np.array(
    [
        [93.0757, 61.4735, 29.5136],
        [104.7473, 88.4744, 43.7652],
        [91.6079, 84.9328, 46.4241],
        [76.1565, 66.5753, 37.9770],
    ]
)
"""Costs of the four demonstrations, shape (4, 3), deg."""

TABLE_2 = np.array(
    [
        [150.3399, 123.8537, 76.0133],
        [154.4538, 131.9417, 87.1472],
        [116.2481, 61.9360, 22.5199],
        [151.1992, 125.5217, 75.6113],
        [145.2563, 111.6739, 46.4094],
        [159.6868, 144.7901, 112.0619],
        [135.1678, 116.9440, 85.4763],
        [152.8853, 128.9745, 86.8828],
        [116.3262, 70.4682, 12.5943],
        [151.6808, 131.7492, 84.1958],
        [150.2374, 137.8092, 103.7207],
    ]
)
"""Costs of the eleven explorations without reward, shape (11, 3), deg."""
