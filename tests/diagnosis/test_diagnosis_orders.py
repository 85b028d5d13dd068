"""Orders over a turn are looked at roughly all, and exactly where it matters; the answers are those of plain loops."""

from __future__ import annotations

import numpy as np
import pytest
from battery.excite import driven, record

import motorid as mi
from motorid.diagnosis import candidates
from motorid.estimation import angle_orders as orders
from motorid.estimation.linearisation import Response, Tangent
from motorid.numerics.autoregression import ORDER, Whitening
from motorid.numerics.parallel import one_thread


def some(rng, n=40, nx=3, ny=2):
    """A response that means nothing."""
    a = rng.normal(0, 0.4, (n - 1, nx, nx))
    return Response(a, rng.normal(size=(n - 1, nx, 2)), rng.normal(size=(n, ny, nx)), {})


def test_the_answer_to_pushes_is_that_of_the_recursion(rng):
    answer, pushes = some(rng), rng.normal(size=(5, 39, 3))
    x, y = np.zeros((5, 3)), np.zeros((40, 2, 5))
    for k in range(39):
        x = x @ answer.a[k].T + pushes[:, k]
        y[k + 1] = answer.c[k + 1] @ x.T
    assert np.allclose(answer.driven(pushes), y, atol=1e-12)


def test_what_pulls_is_the_transpose_of_what_pushes(rng):
    answer, pushes, weights = some(rng), rng.normal(size=(1, 39, 3)), rng.normal(size=(40, 2))
    forward = float(np.sum(answer.driven(pushes)[:, :, 0] * weights))
    assert float(np.sum(answer.pulled(weights) * pushes[0])) == pytest.approx(forward, rel=1e-12)


def test_the_transposed_filters_are_the_transpose(rng):
    white = Whitening.of([rng.normal(size=(60, 2)).cumsum(axis=0), rng.normal(size=(50, 2))])
    runs = [rng.normal(size=(60, 2)), rng.normal(size=(50, 2))]
    rows = rng.normal(size=2 * (60 + 50 - 2 * ORDER))
    back = white.transposed(rows, [60, 50])
    assert sum(float(np.sum(b * r)) for b, r in zip(back, runs, strict=True)) == pytest.approx(
        float(white(runs) @ rows), rel=1e-12
    )


@pytest.mark.parametrize(("effect", "hidden"), [
    ("cogging", {"cogging": {"A": 8e-3, "N": 16, "phi": 0.7}}),
    ("torque_ripple", {"torque_ripple": {"a_r": 0.15, "N_r": 9, "phi_r": 0.7}}),
    ("cogging", {"coulomb": {"tau_c": 0.012}}),
])
@one_thread
def test_the_best_orders_are_those_of_a_look_at_all(lab, effect, hidden):
    rng = np.random.default_rng(6)
    runs = [
        record(driven(lab, hidden, words, 900, 1e-3, rng), "logger", ("i", "omega", "theta"), lab, rng, f"run{k}")
        for k, words in enumerate(("stairs 0.4", "ramps 0.3"))
    ]
    tangent = Tangent.of(mi.fit(mi.dc_motor(), runs))
    looking, kind = orders._order_search(tangent), "torque" if effect == "cogging" else "motor's torque"
    every = looking.orders[1:]
    assert len(every) > 2 * (orders.SAMPLED + orders.LOOKED_AT)
    exact = {line.order: line for line in looking.exact(every, kind)[0]}
    found = orders._spectrum(tangent, kind)
    best = max(exact.values(), key=lambda line: line.share)
    assert found.lines[0].order == best.order
    for line in found.lines:
        assert line.share == pytest.approx(exact[line.order].share, rel=1e-6)
    rough, _ = looking.shares(2, kind)
    assert np.median(rough) == pytest.approx(np.median([line.share for line in exact.values()]), rel=0.3)


@pytest.mark.parametrize("shared", [0.0, 1.0])
def test_a_ripple_of_the_torque_is_told_from_one_of_the_back_emf_too(lab, shared):
    rng, hidden = np.random.default_rng(8), {"torque_ripple": {"a_r": 0.08, "N_r": 7, "phi_r": 0.7, "e_r": shared}}
    runs = [
        record(driven(lab, hidden, words, 900, 1e-3, rng), "logger", ("i", "omega", "theta"), lab, rng, f"run{k}")
        for k, words in enumerate(("stairs 0.4", "ramps 0.3", "ternary 0.3"))
    ]
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), validate=runs[2:])
    assert found.to_dict()["effects"] == ["torque_ripple"]
    assert found.after.values["e_r"] == shared
    assert found.after.fits == "noise"
    assert mi.fit(mi.dc_motor() + mi.effects.torque_ripple, runs).values["e_r"] == shared
    assert mi.fit(mi.dc_motor() + mi.effects.torque_ripple, runs).values["N_r"] == 7


def test_a_piece_of_a_record_too_short_to_tell_an_order_does_no_harm(rng):
    """A log with a pause after eight samples ended the diagnosis, "beyond what can be computed"."""
    motor = mi.dc_motor() + mi.effects.coulomb(tau_c=8e-3)
    t, v = np.arange(400) * 5e-3, np.repeat(rng.uniform(-8, 8, 20), 20)
    runs = []
    for n in (400, 8):
        blank = mi.Experiment(t[:n], {"v": v[:n]}, {"omega": 0 * t[:n]})
        omega = mi.simulate(motor, blank, initial="rest")[0].outputs["omega"]
        runs.append(blank.with_(outputs={"omega": omega + rng.normal(0, 0.3, n)}))
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), effects=["coulomb", "cogging", "encoder_zero"])
    assert found.effects == ("coulomb",)


@pytest.mark.parametrize("every", [1, 50])
def test_what_comes_once_a_turn_is_sought_where_samples_show_a_turn(every, rng):
    """Settled speeds of a wheel, eight turns from row to row: ten minutes went into a cogging that no row shows."""
    t = 0.01 * np.arange(20000)
    motor = mi.dc_motor(R=1.0, L=1e-3, K=0.05, b=1e-4, J=1e-4)
    blank = mi.Experiment(t, {"v": np.repeat(rng.uniform(2, 10, 100), 200)}, {"omega": 0 * t})
    clean = mi.simulate(motor, blank, initial="rest")[0].outputs["omega"]
    run = blank.with_(outputs={"omega": clean + rng.normal(size=len(t))}).decimate(every)
    fit = mi.fit(mi.dc_motor(), run)
    search = candidates.Search(fit, None, candidates.library(None), candidates.Stages())
    periodic = {e.name for e in search.effects if any(p.periodic for p in e.parameters)}
    assert ({"cogging", "gravity", "torque_ripple"} <= periodic) == orders.shows_turns(fit) == (every == 1)
    assert {"coulomb", "spring", "end_stop"} <= {e.name for e in search.effects}
    assert search.whole
