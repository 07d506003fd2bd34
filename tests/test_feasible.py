"""Physically feasible inertial parameters."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import minimize
from warned import told

from crane.common.errors import CraneError, InputError
from crane.identification.mechanics.feasible_parameters import (
    body_parameters,
    load_convex_solver,
    pseudo_inertia,
    solve_feasible,
)


def body(rng, size, mass):
    """Ten parameters of 20 point masses."""
    points = np.column_stack([size * rng.standard_normal((20, 3)) + size, np.ones(20)])
    return body_parameters(points.T @ (mass * rng.dirichlet(np.ones(20))[:, None] * points))


def problem(bodies, others, noise=0.0, rows=3000, seed=0):
    """Regressor, forces, truth, prior; sizes from 3 cm to 1 m, masses from 0.1 to 100 kg."""
    rng = np.random.default_rng(seed)
    truth = [
        body(rng, s, m)
        for s, m in zip(np.geomspace(0.03, 1, bodies), np.geomspace(0.1, 100, bodies), strict=True)
    ]
    prior = []
    for p in truth:
        T = np.eye(4) + np.diag(0.15 * rng.standard_normal(4))
        T[:3, 3] += 0.1 * np.sqrt(p[9] / p[0]) * rng.standard_normal(3)
        prior.append(body_parameters(T @ pseudo_inertia(p) @ T.T))
    friction = rng.uniform(0, 5, others)
    W = rng.standard_normal((rows, 10 * bodies + others))
    truth = np.concatenate([*truth, friction])
    prior = np.concatenate([*prior, 1.2 * friction])
    return W, W @ truth + noise * rng.standard_normal(rows), truth, prior


def names(count):
    return [f"link{i}" for i in range(count)]


def test_pseudo_inertia_is_pinocchios():
    inertia = pin.Inertia.Random()
    P = pseudo_inertia(inertia.toDynamicParameters())
    np.testing.assert_allclose(P, inertia.toPseudoInertia().toMatrix(), atol=1e-12)
    np.testing.assert_allclose(body_parameters(P), inertia.toDynamicParameters(), atol=1e-12)


def test_truth_without_noise():
    W, y, truth, prior = problem(4, 5)
    found = solve_feasible(
        W,
        y,
        np.full(len(y), 1e2),
        names(4),
        prior,
        np.full(4, 1e-3),
        np.full(5, np.inf),
        nonnegative=range(40, 45),
    )
    np.testing.assert_allclose(found, truth, atol=1e-5)
    assert np.linalg.eigvalsh(pseudo_inertia(found[:40].reshape(4, 10))).min() > 0


def test_bodies_exist_where_least_squares_has_none():
    W, y, truth, prior = problem(11, 30, noise=5.0)
    plain = np.linalg.lstsq(W, y)[0]
    assert np.linalg.eigvalsh(pseudo_inertia(plain[:110].reshape(11, 10))).min() < 0
    found = solve_feasible(
        W,
        y,
        np.full(len(y), 0.2),
        names(11),
        prior,
        np.full(11, 25.0),
        np.full(30, np.inf),
        nonnegative=range(110, 140),
    )
    P = pseudo_inertia(found[:110].reshape(11, 10))
    assert (np.linalg.eigvalsh(P)[:, 0] > 0).all()
    assert (found[110:] >= 0).all()
    assert np.sum((0.2 * (W @ found - y)) ** 2) < 1.05 * len(y)
    assert np.linalg.norm(found - truth) < np.linalg.norm(plain - truth)


def test_limits_of_the_prior_weight():
    W, y, truth, prior = problem(2, 2, noise=1e-3)
    weights = np.full(len(y), 1e3)
    spread = np.full(2, 1e-6)
    strong = solve_feasible(W, y, 1e-9 * weights, names(2), prior, np.full(2, 1e6), spread)
    np.testing.assert_allclose(strong, prior, rtol=1e-4, atol=1e-6)
    weak = solve_feasible(W, y, weights, names(2), prior, np.full(2, 1e-4), np.full(2, np.inf))
    np.testing.assert_allclose(weak, np.linalg.lstsq(W, y)[0], atol=1e-6)


def test_dependent_columns_are_left_to_the_prior():
    W, y, truth, prior = problem(2, 0)
    basis = np.linalg.qr(np.random.default_rng(1).standard_normal((20, 12)))[0]
    W = W @ basis @ basis.T
    found = solve_feasible(
        W, W @ truth, np.full(len(y), 1e2), names(2), prior, np.ones(2), np.zeros(0)
    )
    np.testing.assert_allclose(basis.T @ found, basis.T @ truth, atol=1e-3)

    # The truth exists and explains everything: the prior cannot be farther than from it.
    def divergence(one):
        total = 0.0
        for body, other in zip(one.reshape(2, 10), prior.reshape(2, 10), strict=True):
            ratio = np.linalg.solve(pseudo_inertia(other), pseudo_inertia(body))
            total += np.trace(ratio) - np.linalg.slogdet(ratio)[1] - 4
        return total

    misfit = np.sum((1e2 * W @ (found - truth)) ** 2)
    assert misfit + 2 * divergence(found) < 2 * divergence(truth)


def test_a_bound_holds():
    W, y, truth, prior = problem(1, 2)
    truth[10] = -3.0
    found = solve_feasible(
        W, W @ truth, np.ones(len(y)), names(1), prior, np.ones(1), np.full(2, np.inf), [10]
    )
    assert found[10] == pytest.approx(0, abs=1e-6)
    free = solve_feasible(
        W, W @ truth, np.ones(len(y)), names(1), prior, np.ones(1), np.full(2, np.inf)
    )
    assert free[10] == pytest.approx(-3, abs=1e-2)


def test_brute_force_on_one_body():
    """The same minimum over Cholesky factors by a general optimiser."""
    W, y, _, prior = problem(1, 1, noise=1.0, rows=40)
    spread = np.array([0.3])
    P0 = pseudo_inertia(prior[:10])
    inverse, lower = np.linalg.inv(P0), np.linalg.cholesky(P0)

    def unpack(x):
        C = np.zeros((4, 4))
        C[np.tril_indices(4)] = x[:10]
        P = lower @ C @ C.T @ lower.T
        return P, np.append(body_parameters(P), x[10])

    def cost(x):
        P, theta = unpack(x)
        ratio = inverse @ P
        d = np.trace(ratio) - np.linalg.slogdet(ratio)[1] - 4
        pull = (theta[10] - prior[10]) / spread[0]
        return np.sum((W @ theta - y) ** 2) + 8 * d + pull**2

    start = np.append(np.eye(4)[np.tril_indices(4)], prior[10])
    best = minimize(cost, start, method="BFGS", options={"gtol": 1e-7})
    found = solve_feasible(W, y, np.ones(40), ["link"], prior, np.full(1, 4.0), spread)
    np.testing.assert_allclose(found, unpack(best.x)[1], atol=1e-5)


def test_priors_that_cannot_be():
    W, y, _, prior = problem(2, 1)

    def message(change, index=slice(10, 20)):
        wrong = prior.copy()
        wrong[index] = change
        with pytest.raises(InputError) as error:
            solve_feasible(W, y, np.ones(len(y)), ["boom", "stick"], wrong, np.ones(2), np.ones(1))
        return str(error.value)

    for wrong in (message(-1.0, 10), message([1, 0, 0, 0, 1, 0, 1, 0, 0, 3])):
        assert wrong.startswith("prior of 'stick' is flat or no possible body: give it")
    assert message([1, 0, 0, 0, 1, 0, 1, 0, 0, 2]) == wrong


def test_warnings_of_solvers_are_one_line(monkeypatch):
    """Steps of every solver are so few that none converges; CVXPY would advise another one."""
    W, y, _, prior = problem(1, 1, rows=40)
    given = W, y, np.full(40, 1e2), names(1), prior, np.full(1, 1e-3), np.full(1, np.inf)
    exact = solve_feasible(*given)
    problems, calls = load_convex_solver().Problem, []
    real = problems.solve

    def few_steps(self, solver, **options):
        calls.append(solver)
        limit = {"max_iters": 25} if solver == "SCS" else {"max_iter": 1}
        return real(self, solver=solver, **limit)

    monkeypatch.setattr(problems, "solve", few_steps)
    found, lines = told(solve_feasible, *given)
    assert calls == ["CLARABEL", "CLARABEL", "CLARABEL", "SCS"]
    assert lines == [
        "the feasible estimate is accurate to few digits only, as the recording hardly determines "
        "it: give a larger weight to the prior (--prior)"
    ]
    assert 1e-9 < np.abs(found - exact).max() < np.abs(exact).max()


def test_an_estimate_that_no_solver_finds_is_an_error(monkeypatch):
    W, y, _, prior = problem(1, 1, rows=40)
    cvxpy = load_convex_solver()

    def fail(self, **options):
        raise cvxpy.SolverError("try another solver, verbose=True")

    monkeypatch.setattr(cvxpy.Problem, "solve", fail)
    with pytest.raises(CraneError, match="^no feasible estimate .* larger weight to the prior$"):
        solve_feasible(W, y, np.ones(40), names(1), prior, np.ones(1), np.ones(1))
