"""What demonstrations say of each barrier by itself, in nats.

    I(i) = p ln(p/q) + (1 − p) ln((1 − p)/(1 − q)),        p = P(closed | demonstrations),  q = P(closed)

the relative entropy from the prior of a barrier to its posterior (Kullback & Leibler 1951; Lindley 1956). It is 0 where
demonstrations leave the probability as it was, and ln(1/(1 − q)) where they show that the barrier is open. What they
say of barriers jointly, such as “one of these two is closed”, counts as far as it changes each probability.

Where p and q are means of n and m independent samples, they differ by chance: without any evidence, I has a mean of
about 1/(2n) + 1/(2m), and is above 1.9 times 1/n + 1/m once in twenty cases.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.special import expit, rel_entr

from sidestep.errors import check
from sidestep.inference.mrf import BinaryMRF
from sidestep.inference.prior_chains import sample_prior
from sidestep.tabular.grid import Cell


def information(
    posterior: Float[np.ndarray, "*shape"], prior: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Return the information of each barrier in nats, from its prior to its posterior probability.

    Args:
        posterior: P(closed) after demonstrations, from 0 to 1.
        prior: P(closed) before, from 0 to 1.

    Returns:
        The relative entropies, 0 or more; infinite where the prior excluded what the posterior does not.

    Raises:
        InputError: For numbers that are no probabilities.

    Example:
        >>> information(np.array([0.5, 0.0, 0.25]), np.array([0.5, 0.5, 0.5])).round(3).tolist()
        [0.0, 0.693, 0.131]

    References:
        Kullback & Leibler (1951), *On information and sufficiency*; Lindley (1956), *On a measure of the information
        provided by an experiment*.
    """
    for name, values in (("posterior", posterior), ("prior", prior)):
        check(((values >= 0) & (values <= 1)).all(), "expected numbers from 0 to 1", field=name)
    # of nearly equal probabilities, the sum may be below 0 by rounding
    return np.maximum(rel_entr(posterior, prior) + rel_entr(1 - posterior, 1 - prior), 0.0)


def prior_closed(
    prior: BinaryMRF, known: Int[np.ndarray, " barriers"], *, count: int = 2_000, seed: int = 0
) -> Float[np.ndarray, " _"]:
    """Return P(closed) of each barrier before demonstrations.

    Without shape terms it is σ(η). With them it is (n + ½)/(N + 1), where a barrier is closed in n of N samples.

    Args:
        prior: The prior.
        known: The `Cell` value of each barrier; known ones have 0 or 1.
        count: The number of samples, each a sweep after the one before.
        seed: The seed of the samples.

    Example:
        >>> prior_closed(BinaryMRF(np.zeros(3)), np.array([-1, 0, 1])).tolist()
        [0.5, 0.0, 1.0]
    """
    if prior.weights.any():
        samples = sample_prior(prior, known, count, apart=1, seed=seed)
        closed = (samples.sum(axis=0) + 0.5) / (len(samples) + 1)
    else:
        closed = expit(prior.field)
    return np.where(known == Cell.UNKNOWN, closed, known == Cell.OCCUPIED).astype(np.float64)
