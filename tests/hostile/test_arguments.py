"""A wrong argument is named by the function that was called, with what it takes; none is taken for something else."""

from __future__ import annotations

import inspect
import pickle

import numpy as np
import pytest

import motorid as mi
from motorid.records.datasets import data_path

RUN = mi.read_csv(data_path("clean") / "run1.csv")
FIT = mi.fit(mi.dc_motor(), [RUN])
ODD = (5, "x", [None], object(), np.arange(3.0), float("nan"), mi.Model)

TAKES = {  # one function of every kind: results, records, files, numbers, words, mappings, callables
    "locate": mi.locate,
    "evaluate": lambda x: mi.evaluate(FIT, x),
    "compare": mi.compare,
    "profile": lambda x: mi.profile(x, "R", quiet=True),
    "identifiability": mi.identifiability,
    "points": lambda x: mi.identifiability(FIT, points=x) if x != 5 else mi.locate(x),
    "read_csv": mi.read_csv,
    "columns": lambda x: mi.read_runs(data_path("two_step"), columns=x),
    "data_path": mi.data_path,
    "dc_motor": lambda x: mi.dc_motor(R=x) if x != 5 else mi.locate(x),
    "fix": lambda x: mi.dc_motor().fix(x),
    "decimate": lambda x: RUN.decimate(x) if x != 5 else mi.locate(x),
    "effect": lambda x: mi.effect(balance=x)(lambda m, c=mi.P(1.0): None),
    "fit_many": lambda x: mi.fit_many(mi.dc_motor(), x, quiet=True),
    "plot_residuals": mi.plot_residuals,
    "loss": lambda x: mi.fit(mi.dc_motor(), RUN, loss=x),
    "solver": lambda x: mi.fit(mi.dc_motor(), RUN, solver=x if x is not mi.Model else mi.MultipleShooting),
    "penalties": lambda x: mi.fit(mi.dc_motor(), RUN, penalties=[x if x is not mi.Model else mi.CurrentLimit]),
    "also": lambda x: mi.diagnose(FIT, also=[x]),
    "window": lambda x: mi.fit(mi.dc_motor(), RUN, window=x) if x != 5 else mi.locate(x),
    "iterations": lambda x: mi.LevenbergMarquardt(max_iterations=x) if x != 5 else mi.locate(x),
    "CurrentLimit": lambda x: mi.CurrentLimit(x) if x != 5 else mi.locate(x),
    "certainty": FIT.certainty,
    "evaluated": lambda x: mi.evaluate(x, RUN),
}


@pytest.mark.parametrize("name", TAKES)
def test_an_argument_of_another_kind_is_named(name):
    for odd in ODD:
        if isinstance(odd, np.ndarray) and name in ("points", "dc_motor", "decimate", "window", "iterations",
                                                    "CurrentLimit"):
            odd = (1, 2)
        with pytest.raises(mi.MotoridError) as told:
            TAKES[name](odd)
        assert not any(w in str(told.value) for w in ("object has no attribute", "subscriptable", "ufunc")), told.value


@pytest.mark.parametrize("call", [
    lambda: mi.fit(mi.dc_motor(), RUN, priors={"R": (1.0, -1.0)}),
    lambda: mi.fit(mi.dc_motor(), RUN, priors={"R": (float("nan"), 1.0)}),
    lambda: mi.fit(mi.dc_motor(), RUN, priors={"R": 5}),
    lambda: mi.profile(FIT, "R", level=95, quiet=True),
    lambda: mi.profile(FIT, "R", level=0.0, quiet=True),
    lambda: mi.Huber(float("nan")),
    lambda: mi.diagnose(FIT, budget=float("nan")),
    lambda: mi.diagnose(FIT, budget=-1),
    lambda: mi.diagnose(FIT, max_effects=-1),
    lambda: mi.design_experiment([]),
    lambda: mi.design_experiment([], goal="sharpen"),
    lambda: mi.bootstrap(FIT, n=3, block=0, quiet=True),
    lambda: mi.bootstrap(FIT, n=3, block=-5, quiet=True),  # had no end
    lambda: mi.bootstrap(FIT, n=3, seed=-1, quiet=True),
    lambda: mi.multistart(FIT, starts=2, seed=-1, quiet=True),
    lambda: mi.identifiability(FIT, points=0),
    lambda: mi.LevenbergMarquardt(ftol=-1.0),
    lambda: mi.MultipleShooting(max_iterations=0),
    lambda: mi.MultipleShooting(tol=0.0),
    lambda: mi.check_derivatives(FIT.problem, steps=np.array(1e-3)),  # one number in an array is no list
    lambda: mi.MultipleShooting(process_noise={"i": -1.0}),
    lambda: mi.Rosenbrock(most_steps=0),
    lambda: mi.Cvodes(rtol=-1.0),
    lambda: mi.Idas(atol=float("inf")),
    lambda: mi.Constraint(lambda m: m.i, upper=1.0, size=float("inf")),
    lambda: mi.improve(FIT, max_effects=-1),
    lambda: mi.check_derivatives(FIT.problem, steps=()),
    lambda: mi.check_derivatives(FIT.problem, tolerance=0.0),
    lambda: mi.compare_formulations(FIT, weights=[-1.0]),
    lambda: mi.design_experiment(FIT, duration=1e300),
    lambda: mi.design_experiment(FIT, duration=1.0, dt=10.0),
    lambda: mi.design_experiment(FIT, budget=-1.0),
    lambda: mi.identify_on(mi.virtual_bench(), v_max=-1.0, i_max=1.0),
    lambda: mi.virtual_bench(seed=-1),
    lambda: mi.planned(mi.dc_motor(), [0, 1, 2], [1, 1, 1], sigma={"i": 0.0}),
    lambda: mi.plot_current_limit(FIT, limit=0.0),
    lambda: mi.plot_missing(mi.locate(FIT), show=0),
    lambda: mi.plot_missing(mi.locate(FIT), run=1),
    lambda: mi.plot_missing(mi.locate(FIT), run=-1),
    lambda: mi.multistart(FIT, starts=2, solver=0, quiet=True),
    lambda: mi.fit(mi.dc_motor(), RUN, loss=0),
    lambda: mi.fit(mi.dc_motor(), RUN, window=True),
    lambda: mi.fit(mi.dc_motor(), RUN, priors={"R": ("x", 1.0)}),
    lambda: mi.identifiability(FIT, seed=-1),
    lambda: mi.fit(mi.dc_motor(), RUN, penalties=[3]),
    lambda: mi.fit(mi.dc_motor(), RUN, constraints=["x"], formulation="penalty"),
    lambda: mi.effects.coulomb(tau_c="x"),
    lambda: mi.multistart(FIT, starts=2, spread=1e300, quiet=True),
    lambda: mi.multistart(FIT, starts=2, spread=float("inf"), quiet=True),
    lambda: mi.suggest_experiment([FIT, FIT], duration=1e300),
    lambda: mi.suggest_experiment([FIT, FIT], duration=1e6),
    lambda: mi.suggest_experiment([FIT, FIT], duration=1e-9),
    lambda: mi.suggest_experiment([FIT, FIT], v_max=1e300),
    lambda: mi.design_experiment(FIT, duration=0.5, dt=1e-12),
    lambda: mi.SteadyState(at=["x"]),
    lambda: mi.SteadyState(at=[(0, 1.0)]),
    lambda: mi.fit(mi.dc_motor(), RUN, loss=mi.Huber),
    lambda: mi.plot_parameters(FIT, names=["Q"]),
    lambda: mi.plot_runs(RUN, ["q"]),
    lambda: mi.export(FIT, "a\0.json")])
def test_a_number_that_cannot_be_meant_is_refused(call):
    with pytest.raises(mi.UsageError):
        call()


KINDS = {"float": (True, "x", float("nan"), []), "int": (True, "x", 1.5, float("nan"), []), "bool": ("x", [], 2),
         "str": (0, True, [])}
FITTING = {"Mapping": {}, "Callable": print, "tuple": (), "float": 1.0, "str": "x", "Path": "x"}


@pytest.mark.parametrize("name", [n for n in dir(mi) if callable(getattr(mi, n)) and not n.endswith("Error")])
def test_no_number_word_or_flag_is_taken_for_another(name):
    """Many a wrong one does its harm without an error: a limit of True is one of 1, NaN is below nothing."""
    function = getattr(mi, name)
    takes = {p.name: p for p in inspect.signature(function).parameters.values() if p.kind is not p.VAR_POSITIONAL}
    words = {p: str(q.annotation) for p, q in takes.items()}
    for asked, kind in words.items():
        first = kind.removesuffix(" | None")
        for odd in KINDS.get(first, ()):
            if odd != odd and takes[asked].default != takes[asked].default:
                continue  # not known is what its default says
            others = [p for p in takes.values() if p.default is p.empty and p.kind is not p.VAR_KEYWORD]
            given = {p.name: next((v for k, v in FITTING.items() if k in words[p.name]), None) for p in others}
            with pytest.raises(mi.MotoridError) as told:
                function(**{**given, asked: odd})
            assert f": {asked} takes" in str(told.value) or isinstance(function, type)  # which may have its own words


def test_numbers_of_other_kinds_are_numbers():
    assert mi.dc_motor(R=np.float32(1.5)).parameters["R"].value == 1.5
    assert mi.dc_motor(R=np.array(2)).parameters["R"].value == 2
    assert mi.LevenbergMarquardt(max_iterations=np.int64(3)).max_iterations == 3
    assert mi.identifiability(FIT, points=np.uint8(1), seed=0).rank


def test_what_an_effect_cannot_mean_is_refused():
    with pytest.raises(mi.ModelError, match="at_least of 'c'"):
        mi.effect(balance="torque")(_law(mi.P(1.0, at_least="tau")))
    for given in ({"null": "x"}, {"null": True}, {"lower": float("nan")}, {"grid": "x"}, {"per_run": "x"}):
        with pytest.raises(mi.UsageError, match="takes"):
            mi.P(1.0, **given)


def _law(c):
    def law(m, c=c):
        m.torque -= c * m.omega

    return law


def test_a_block_of_the_bootstrap_is_at_most_a_run():
    assert mi.bootstrap(FIT, n=2, block=10**9, quiet=True).block == RUN.n


def test_what_is_no_function_is_no_effect():
    with pytest.raises(mi.ModelError, match="an effect is a function"):
        mi.effect(balance="torque")(3)


def test_a_wrong_option_is_no_failure_of_every_motor():
    with pytest.raises(TypeError, match="wibble"):
        mi.fit_many(mi.dc_motor(), {"a": RUN}, wibble=3, quiet=True)
    with pytest.raises(TypeError, match="wibble"):
        mi.fit_many(mi.dc_motor(), {"a": "run.csv"}, reading={"wibble": 3}, quiet=True)


@pytest.mark.parametrize(("wrong", "says"), [
    ({"excite": 3}, "excite takes"), ({"progress": 3}, "progress takes"),
    ({"calibration": {"i": {"scale": "x"}}}, "scale must be a number"),
    ({"calibration": {"i": 2.0}}, "expected a table")])
def test_what_is_wrong_of_a_recording_is_not_blamed_on_the_port(wrong, says, tmp_path):
    with pytest.raises(mi.MotoridError, match=says):
        mi.record(mi.virtual_bench("coulomb"), tmp_path / "run.csv", **{"excite": "step:1:0.05", **wrong})
    with pytest.raises(mi.UsageError, match="port takes"):
        mi.record(3, tmp_path / "other.csv")  # type: ignore[arg-type]  # the mistake itself


def test_an_error_of_the_callers_own_stays_what_it_is():
    def callback(*_: object) -> None:
        raise TypeError("mine")

    with pytest.raises(TypeError, match="mine"):
        mi.fit(mi.dc_motor(), RUN, callback=callback)
    assert pickle.loads(pickle.dumps(mi.fit)) is mi.fit  # a pool takes it along
