"""Cross-validation beside closed forms of a coin, and its standard errors beside their definition."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import log_expit

import sidestep as ss
from sidestep.errors import InputError

FAILURES = [0, 2, 3, 1, 0, 6]


def coin() -> ss.TiedModel:
    """An action that succeeds with the unknown probability σ(θ), and otherwise stays."""
    return ss.TiedModel(ss.graph(np.array([[[1, 0]], [[1, 1]]])), np.array([[[0, ss.FIXED]], [[0, ss.FIXED]]]))


def fit_of_coins(chosen=slice(None), prior=1e6) -> ss.Fit:
    walks = [ss.Trajectory(np.repeat([0, 1], [n + 1, 1]), np.zeros(n + 1, int), 0) for n in FAILURES]
    shown = ss.gather(walks, [ss.task(np.array([-1.0, 0.0]), 0.9, np.array([False, True]))])
    counted = np.zeros(len(FAILURES), bool)
    counted[chosen] = True
    behavior = ss.Behavior(ss.BoltzmannAverage())
    return ss.fit(coin(), shown.with_only(counted), behavior, prior=ss.Normal(0.0, prior), terms=("transitions",))


@pytest.mark.parametrize("warm_start", [False, True])
def test_cross_validate_of_coins_has_the_held_out_likelihood_of_each_walk(warm_start):
    result = ss.cross_validate(fit_of_coins(), folds=3, warm_start=warm_start)
    failures = np.array(FAILURES)
    assert sorted(result.fold.tolist()) == [0, 0, 1, 1, 2, 2]
    expected = np.zeros(6)
    for fold in range(3):
        others = failures[result.fold != fold]
        p = len(others) / (len(others) + others.sum())  # of a geometric distribution
        held_out = result.fold == fold
        expected[held_out] = np.log(p) + failures[held_out] * np.log1p(-p)
    np.testing.assert_allclose(result.held_out.of("walk"), expected, rtol=1e-5)
    assert result.converged.all()
    nats, moves = result.of_folds.T
    np.testing.assert_allclose(nats, [expected[result.fold == fold].sum() for fold in range(3)], rtol=1e-5)
    assert moves.tolist() == [(1 + failures[result.fold == fold]).sum() for fold in range(3)]


def test_cross_validate_without_moves_that_do_not_count_is_that_of_the_others():
    result = ss.cross_validate(fit_of_coins(slice(0, 4)), folds=4)
    assert result.fold[4:].tolist() == [-1, -1]
    assert sorted(result.fold[:4].tolist()) == [0, 1, 2, 3]
    np.testing.assert_allclose(result.mean.estimate, result.held_out.of("walk").sum() / 10)


def test_cross_validate_holds_out_groups_together():
    groups = np.array([7, 3, 7, 5, 3, 5])
    folds = {seed: ss.cross_validate(fit_of_coins(), folds=3, groups=groups, seed=seed).fold for seed in (0, 0, 1, 2)}
    for fold in folds.values():
        assert len(set(zip(groups, fold, strict=True))) == 3
    assert any((folds[0] != fold).any() for fold in folds.values())
    again = ss.cross_validate(fit_of_coins(), folds=3, groups=groups, seed=1)
    np.testing.assert_array_equal(again.fold, folds[1])


def validation(nats, moves) -> ss.CrossValidation:
    """Folds of one walk each, with these nats and moves."""
    walk = np.repeat(np.arange(len(moves)), moves)
    each = ss.PointwiseLogLikelihood(
        np.repeat(np.divide(nats, moves), moves), np.zeros(len(walk)), walk, np.ones(len(walk))
    )
    return ss.CrossValidation(each, np.arange(len(moves)), np.ones(len(moves), bool))


def test_mean_of_folds_of_one_size_has_the_usual_standard_error():
    random = np.random.default_rng(0)
    nats, others = random.normal(size=(2, 8))
    one, other = validation(nats, np.full(8, 3)), validation(others, np.full(8, 3))
    for result, sums in ((one.mean, nats), (one.difference(other), nats - others)):
        assert result.estimate == pytest.approx(sums.mean() / 3)
        assert result.standard_error == pytest.approx(sums.std(ddof=1) / np.sqrt(8) / 3)


def test_mean_of_folds_that_are_equally_predictable_has_no_error():
    mean, error = validation([-2.0, -4.0, -6.0], [1, 2, 3]).mean
    assert mean == -2
    assert error == pytest.approx(0, abs=1e-12)


def test_mean_with_an_impossible_move_has_no_error():
    assert validation([-2.0, -np.inf], [1, 2]).mean == ss.Estimate(-np.inf, None)


def test_difference_of_other_folds_raises():
    with pytest.raises(InputError, match="field 'other': expected the same moves and folds"):
        validation([-1.0, -2.0], [1, 2]).difference(validation([-1.0, -2.0], [2, 1]))


@pytest.mark.parametrize(("options", "message"), [
    ({"folds": 1}, "field 'folds': expected at least 2, found 1"),
    ({"folds": 7}, "field 'folds': expected at most 6, the number of groups with moves that count, found 7"),
    ({"folds": 3, "groups": np.array([0, 0, 0, 1, 1, 1])}, "expected at most 2, the number of groups"),
    ({"groups": np.zeros(5, int)}, r"field 'groups': expected a whole number for each of the 6 trajectories"),
])  # fmt: skip
def test_cross_validate_of_too_few_groups_raises(options, message):
    with pytest.raises(InputError, match=message):
        ss.cross_validate(fit_of_coins(), **options)


def test_cross_validate_of_a_person_left_out_predicts_by_the_fit_to_the_others():
    """To go on is worth γ = ½, to stay first γ²: an agent of inverse temperature β goes with probability σ(β/4)."""
    graph = ss.graph(np.array([[[1], [0]], [[1], [1]]]))
    stays, person = np.array([0, 1, 3, 4]), np.array([0, 0, 1, 1])
    walks = [ss.Trajectory(np.array([0] * n + [0, 1]), np.array([1] * n + [0]), 0) for n in stays]
    demos, of_tasks = ss.split_by_person(ss.gather(walks, [ss.reach(graph, 1, discount=0.5)]), person)
    unknown = ss.behavior_model(ss.Behavior(ss.HardMax(), 2.0), person=of_tasks)
    fit = ss.fit(ss.TabularModel(graph, jnp.zeros((2, 2, 1))), demos, unknown, terms=("actions",))
    result = ss.cross_validate(fit, folds=2, groups=person)
    for held_out in (0, 1):
        others = ss.fit(fit.problem.model, demos.with_only(person != held_out), unknown, terms=("actions",))
        beta = float(others.behavior.behavior_of(held_out).beta)
        expected = log_expit(beta / 4) + stays[person == held_out] * log_expit(-beta / 4)
        np.testing.assert_allclose(result.held_out.of("walk")[person == held_out], expected, rtol=1e-6)
