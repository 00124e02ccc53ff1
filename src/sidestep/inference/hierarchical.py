"""A hierarchical prior of barriers: a binary Markov random field with unknown density and strength.

    p(z, δ, λ) = p(δ, λ) · exp(Σ_i (f_i + u_i δ) z_i + λ h(z)) / Z(δ, λ)

h(z) is the log-density of a `BinaryMRF`, up to a constant. u_i is 1 where the log-odds δ are those of a barrier, and 0
where its log-odds f_i are known, as where sensors saw it. δ and λ take values on a grid, and are drawn from their
conditional distribution before each sweep (Gibbs sampling).

Z(δ, λ) does not depend on the walks. It is found by thermodynamic integration (Kirkwood 1935; Gelman & Meng 1998,
*Simulating normalizing constants*): ∂ log Z/∂λ = E[h(z)], the mean over chains of the prior alone, with λ rising and
falling, and Z(δ, 0) = Π_i (1 + exp(f_i + u_i δ)).

Agents are in open cells because they have to be. A place has halls where they walk and walls between, and one density
does not describe both: with each crossed cell as evidence of the density, the walls of an office vanish. So barriers
that walks crossed enter with a weight α = min(1, c / crossed): together they count as c of them at most, with c = 25 or
a 36th of the unknown barriers, whichever is more.

    log Z = (1 − α) log Z(barriers that were not crossed, given the others) + α log Z(all unknown barriers)

α = 1 is the posterior of this model; α = 0 conditions on what walks crossed (a power posterior between the two; Friel &
Pettitt 2008).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Integer
from scipy.special import expit

from sidestep._arguments import to_finite, to_floats, to_mask
from sidestep._repr import short_repr
from sidestep.errors import check, check_instance, describe, to_number
from sidestep.inference.mrf import SHAPE_TERMS, BinaryMRF
from sidestep.inference.prior_chains import native_terms, run_prior
from sidestep.tabular.grid import Cell
from sidestep.tabular.solvers.native import run_batch

_LOG_ODDS = np.arange(-1.0, 1.26, 0.25)
"""The values of δ."""
_STRENGTHS = np.arange(0.0, 1.76, 0.25)
"""The values of λ."""
_LOG_ODDS_PRIOR, _STRENGTH_PRIOR = (-0.3, 0.3), (1.0, 0.4)
"""The means and standard deviations of δ and λ, normal and cut off at the ends of the grid."""
_STRENGTH_COST = 2.25
"""The log-odds that a closed cell loses for each unit of strength, so that walls of any strength are equally dense."""
_MOST_CROSSED, _CROSSED_PART = 25.0, 1 / 36
"""The most crossed barriers that count as evidence of the density: this number, or this part of the unknown ones."""
_SWEEPS, _PROPOSALS, _CELLS = 40, 10_000, 2_000_000
"""The fewest sweeps at each δ and λ on the way up and down; the proposals from which more are not made, and the most
barriers that more may store."""


@short_repr()
@dataclass(frozen=True, eq=False)
class HierarchicalMRF:
    """A binary Markov random field with unknown log-odds δ and strength λ of its shapes.

    Attributes:
        shapes: h, the field that the strength multiplies.
        field: f, the log-odds of each barrier that do not vary.
        varied: u, whether δ adds to the log-odds of each barrier.
        log_odds: The values of δ.
        strengths: The values of λ, ascending from 0; any single value where δ has a single one too.
        log_prior: log p(δ, λ), up to a constant.
        most_crossed: The most crossed barriers that count as evidence of the density, at least 0; a 36th of the unknown
            barriers where that is more. With 0 none count.

    Raises:
        InputError: For numbers that do not fit these ranges.

    Example:
        >>> prior = hierarchical_mrf(np.full(12, np.nan), (3, 4))
        >>> prior.at(-1.0, 0.0).field.tolist() == [-1.0] * 12
        True
    """

    shapes: BinaryMRF
    field: Float[np.ndarray, " barriers"]
    varied: Bool[np.ndarray, " barriers"]
    log_odds: Float[np.ndarray, " densities"]
    strengths: Float[np.ndarray, " strengths"]
    log_prior: Float[np.ndarray, "densities strengths"]
    most_crossed: float = _MOST_CROSSED

    def __post_init__(self) -> None:
        check_instance(self.shapes, BinaryMRF, "shapes")
        barriers = (len(self.shapes.field),)
        field, varied = to_finite(self.field, "field", barriers), to_mask(self.varied, "varied", barriers)
        log_odds = to_finite(self.log_odds, "log_odds", ("densities",))
        strengths = to_finite(self.strengths, "strengths", ("strengths",))
        log_prior = to_finite(self.log_prior, "log_prior", (len(log_odds), len(strengths)))
        check(log_prior.size, "expected at least one density and strength, found none", field="log_prior")
        rises = (np.diff(strengths) > 0).all() and (log_prior.size == 1 or strengths[0] == 0)
        message = f"expected ascending numbers from 0, or a single one with one δ, found {describe(strengths.tolist())}"
        check(rises, message, field="strengths")
        most_crossed = to_number(self.most_crossed, "most_crossed", least=0)
        names = ("field", "varied", "log_odds", "strengths", "log_prior", "most_crossed")
        values = (field, varied, log_odds, strengths, log_prior, most_crossed)
        for name, value in zip(names, values, strict=True):
            object.__setattr__(self, name, value)

    def at(self, log_odds: float, strength: float) -> BinaryMRF:
        """Return the prior at one δ and λ.

        Args:
            log_odds: δ.
            strength: λ.
        """
        log_odds, strength = to_number(log_odds, "log_odds"), to_number(strength, "strength")
        weights = dict(zip(SHAPE_TERMS, strength * self.shapes.weights, strict=True))
        field = self.field + log_odds * self.varied + strength * self.shapes.field
        return BinaryMRF(field, self.shapes.shape, **weights)

    def log_densities(
        self, closed: Bool[np.ndarray, "*maps barriers"] | Integer[np.ndarray, "*maps barriers"]
    ) -> Float[np.ndarray, "*maps densities strengths"]:
        """Return log p(z, δ, λ) + log Z(δ, λ) of maps at each δ and λ, up to a constant.

        Args:
            closed: Whether each barrier is closed.
        """
        of_shapes = self.strengths * self.shapes.log_density(closed)[..., None]
        maps = np.asarray(closed)
        of_field, varied = maps @ self.field, maps @ self.varied.astype(np.int64)
        of_log_odds = of_field[..., None] + self.log_odds * varied[..., None]
        return self.log_prior + of_log_odds[..., :, None] + of_shapes[..., None, :]


def hierarchical_mrf(
    field: Float[np.ndarray, " barriers"] | Sequence[float],
    shape: tuple[int, int] | None = None,
    *,
    lines: float = 2.5,
    pairs: float = 0.0,
    blocks: float = -3.0,
    isolated: float = -1.0,
) -> HierarchicalMRF:
    """Return the default prior of barriers that are open or closed: that of walls of unknown density and strength.

    Args:
        field: The log-odds of each barrier where they are known, as where sensors saw it; NaN elsewhere.
        shape: The rows and columns where barriers are the cells of a grid.
        lines, pairs, blocks, isolated: The weights of shapes at strength 1, in nats; without effect without a grid.

    Raises:
        InputError: As `BinaryMRF` does.

    Example:
        >>> len(hierarchical_mrf(np.full(7, np.nan)).strengths)  # barriers that are no cells have no shapes
        1
    """
    log_odds = to_floats(field, "field", ("barriers",))
    varied = np.isnan(log_odds)
    strengths = np.zeros(1) if shape is None else _STRENGTHS
    weights = (0.0,) * 4 if shape is None else (lines, pairs, blocks, isolated)
    cost = 0.0 if shape is None else _STRENGTH_COST
    shapes = BinaryMRF(np.where(varied, -cost, 0.0), shape, *weights)
    of_log_odds, of_strengths = (
        -(((values - mean) / deviation) ** 2) / 2
        for values, (mean, deviation) in ((_LOG_ODDS, _LOG_ODDS_PRIOR), (strengths, _STRENGTH_PRIOR))
    )
    log_prior = of_log_odds[:, None] + of_strengths
    return HierarchicalMRF(shapes, np.where(varied, 0.0, log_odds), varied, _LOG_ODDS, strengths, log_prior)


def as_hierarchical(prior: BinaryMRF | HierarchicalMRF) -> HierarchicalMRF:
    """Return a prior of known density and strength as a hierarchical one with a single δ = 0 and λ = 1.

    Args:
        prior: The prior; a hierarchical one is returned as it is.
    """
    if isinstance(prior, HierarchicalMRF):
        return prior
    zeros = np.zeros(len(prior.field))
    return HierarchicalMRF(prior, zeros, zeros > 0, np.zeros(1), np.ones(1), np.zeros((1, 1)))


def log_normalizers(
    prior: HierarchicalMRF, free: Int[np.ndarray, " free"], closed: Bool[np.ndarray, " barriers"], seed: int
) -> Float[np.ndarray, "densities strengths"]:
    """Return log Z(δ, λ) over some barriers, given the others, up to a constant.

    Args:
        prior: The prior.
        free: The barriers over which Z sums.
        closed: Whether each of the others is closed.
        seed: The seed of the chains; the result does not depend on the number of cores.
    """
    result = np.zeros(prior.log_prior.shape)
    others = closed.copy()
    others[free] = False
    sweeps = max(_SWEEPS, min(_PROPOSALS // max(1, len(free)), _CELLS // max(1, len(closed))))
    # other streams than those of the sampler's chains, which have the same seed
    sequences = np.random.SeedSequence(seed, spawn_key=(1,)).spawn(len(prior.log_odds))

    def integrals(at: int, field: np.ndarray, sequence: np.random.SeedSequence) -> np.ndarray:
        """Return the integrals of E[h] from λ = 0 to each other λ."""
        random = np.random.Generator(np.random.PCG64(sequence))
        z = others.astype(np.uint8)
        z[free] = random.random(len(free)) < expit(field[free])
        means = np.zeros((2, len(prior.strengths)))
        for way, order in enumerate((1, -1)):
            for place in np.arange(len(prior.strengths))[::order]:
                terms = native_terms(prior.at(prior.log_odds[at], float(prior.strengths[place])))
                samples = run_prior(terms, free, z, sweeps, random)[sweeps // 3 :]
                means[way, place] = prior.shapes.log_density(samples).mean()
        slopes = means.mean(axis=0)
        return np.cumsum((slopes[1:] + slopes[:-1]) / 2 * np.diff(prior.strengths))

    def integrate(index: tuple[int, ...]) -> None:
        (at,) = index
        field = prior.at(prior.log_odds[at], 0.0).field
        result[at] = np.logaddexp(0, field[free]).sum() + field @ others
        if len(prior.strengths) > 1:
            result[at, 1:] += integrals(at, field, sequences[at])

    if prior.log_prior.size > 1:
        run_batch(integrate, [(at,) for at in range(len(prior.log_odds))])
    return result


def evidence_normalizers(
    prior: HierarchicalMRF, known: Int[np.ndarray, " barriers"], free: Int[np.ndarray, " free"], seed: int
) -> Float[np.ndarray, "densities strengths"]:
    """Return log Z(δ, λ) in which barriers that walks crossed have their weight, up to a constant.

    Args:
        prior: The prior.
        known: The `Cell` value of each barrier.
        free: The unknown barriers that walks did not cross.
        seed: The seed of the chains.
    """
    unknown, closed = np.flatnonzero(known == Cell.UNKNOWN), known == Cell.OCCUPIED
    crossed = len(unknown) - len(free)
    result = log_normalizers(prior, free, closed, seed)
    if crossed == 0 or prior.most_crossed == 0:
        return result
    weight = min(1.0, max(prior.most_crossed, _CROSSED_PART * len(unknown)) / crossed)
    return (1 - weight) * result + weight * log_normalizers(prior, unknown, closed, seed)
