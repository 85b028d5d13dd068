"""The next experiment: the one whose outcome the rival models predict most differently, or that sharpens parameters.

`suggest_experiment` compares fixed candidates within the limits: the squared difference of the rivals' outputs over the
noise is what a record would add to the evidence between them (Hunter & Reiner, Technometrics 7(3), 1965).
`design_experiment` starts there and optimises the voltage; see `motorid.diagnosis.design_criteria`."""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from io import StringIO
from itertools import combinations, permutations
from pathlib import Path
from typing import Any

import numpy as np

from motorid.acquire.excitation import program
from motorid.channels import UNITS, channel_name
from motorid.diagnosis.design_criteria import MOST_SEGMENTS, Driven, Found, Layout, Rival, Task, climb, nearest
from motorid.diagnosis.results import Diagnosis
from motorid.display.cards import Card, Flag, Printed, Shown, Table
from motorid.display.numbers import number, quantity
from motorid.errors import FitError, MotoridError, UsageError, among, at_least, chosen, positive
from motorid.estimation.result import Fit
from motorid.model.model import Model
from motorid.numerics import parallel
from motorid.numerics.signals import Array
from motorid.problem.simulate import planned
from motorid.records.experiment import Experiment, units_of
from motorid.records.files import write_files

SAMPLES = 2000
LONGEST = 1e5  # s
MOST_SAMPLES = 1e9
OMITTED = " Leave it out for that of the records."


@dataclass(frozen=True, eq=False, repr=False)
class Suggestion(Shown):
    """An experiment that would distinguish rival models."""

    name: str
    text: str
    experiment: Experiment  # time and voltage to apply; its outputs are what the first model predicts
    discrimination: Mapping[str, float]  # per candidate: least expected chi² per sample between two rivals

    def card(self) -> Card:
        """Return the experiment chosen, and how well each candidate would do."""
        best = sorted(self.discrimination.items(), key=lambda p: -p[1])
        rows = [[Flag(n, "good") if n == self.name else n, number(v, 3)] for n, v in best]
        return Card("Next experiment", (Flag(self.name, "good"),), (self.text,),
                    (Table(["experiment", "expected χ² per sample between the models"], rows),),
                    (("mi.plot_runs(suggestion.experiment)", "see it"),))


@parallel.one_thread
def suggest_experiment(fits: Sequence[Fit], *, v_max: float | None = None, i_max: float | None = None,
                       duration: float | None = None) -> Suggestion:
    """Choose the experiment that best distinguishes the models of `fits`.

    Parameters
    ----------
    fits : sequence of Fit
        At least two rival models, fitted to the same records.
    v_max, i_max : float, optional
        Limits in V and A; by default the largest voltage in the records, and no limit of the current.
    duration : float, optional
        s; by default that of the longest record.

    Raises
    ------
    UsageError, FitError
        If fewer than two fits are given, or no candidate can be simulated with all of them.

    Examples
    --------
    >>> drag = mi.fit(fit.model + mi.effects.quadratic_drag, runs)
    >>> next_run = mi.suggest_experiment([better, drag], v_max=12)
    """
    if len(fits) < 2:
        raise UsageError("suggest_experiment() compares models: give at least two fits of the same records.")
    positive(OMITTED, v_max=v_max, i_max=i_max, duration=duration)
    runs = fits[0].problem.experiments
    units = {c: u for c, u in units_of(runs).items() if c in ("v", *fits[0].problem.outputs)}
    v_max = v_max or max(float(np.abs(r.inputs["v"]).max()) for r in runs)
    duration = duration or max(r.duration for r in runs)
    dt = float(np.median([r.dt for r in runs]))
    _check_span(duration, dt)
    t = np.arange(0.0, duration, max(dt, duration / SAMPLES))
    sigma = {c: s for run in fits[0].problem.runs for c, s in run.sigma.items()}
    scores, kept = {}, {}
    for name, (v, what) in candidates(t, v_max).items():
        with contextlib.suppress(MotoridError):
            answers = [planned(f.model, t, v, channels=f.problem.outputs, name=name).outputs for f in fits]
            if not i_max or all(float(np.abs(y.get("i", 0.0)).max()) <= i_max for y in answers):
                scores[name] = min(float(np.mean([np.mean(((a[c] - b[c]) / sigma[c]) ** 2) for c in a if c in sigma]))
                                   for a, b in combinations(answers, 2))
                text = f"{what} (up to {quantity(v_max, runs[0].units['v'], 3)}, {duration:.3g} s)"
                kept[name] = Suggestion(name, text, Experiment(t, {"v": v}, answers[0], name=name, units=units), scores)
    if not scores:
        raise FitError("no candidate experiment stays within the limits with all models; raise i_max or v_max.")
    return kept[max(scores, key=lambda n: scores[n])]


def candidates(t: Array, v_max: float) -> dict[str, tuple[Array, str]]:
    """Return the candidate voltages and what each of them is."""
    s = t / max(t[-1], 1e-12)
    levels = np.array([0, 0.3, 0.6, 1.0, 0.6, 0.3, -0.3, -0.6, -1.0, -0.6, -0.3, 0.15, -0.15])
    staircase = v_max * levels[np.minimum((s * len(levels)).astype(int), len(levels) - 1)]
    chirp = v_max * np.sin(2 * np.pi * (t[-1] * 1.0 * (s + 10 * s**2)) / max(t[-1], 1e-12) * 3)
    return {"reversals": (v_max * np.sign(np.sin(2 * np.pi * 4 * s + 1e-9)), "reversals at full voltage"),
        "staircase": (staircase, "a staircase through zero, both directions"),
        "slow sweep": (v_max * (2 * np.abs(2 * ((s + 0.25) % 1) - 1) - 1), "a slow triangle through zero"),
        "low speed": (0.25 * v_max * np.sin(2 * np.pi * 3 * s), "slow reversals at a quarter of the voltage"),
        "coast-down": (v_max * (s < 0.4), "run up and coast down at zero voltage"),
        "chirp": (0.7 * v_max * chirp / max(np.abs(chirp).max(), 1e-12), "a chirp"),
        "warm-up": (np.where((10 * s) % 1 < 0.8, v_max, -v_max),
                    "full voltage with short hard reversals, which also warms the winding"),
        "small steps": (v_max * (0.5 + 0.1 * np.sign(np.sin(2 * np.pi * 10 * s + 1e-9))), "small steps at half speed")}


GOALS, SHAPES = ("distinguish", "sharpen"), ("steps", "free", "multisine")
LEVELS = 30  # a board takes 32 segments
SHORTEST = 5  # ms of a segment
FINE = 200  # steps by which a fixed candidate is followed
MOST_RIVALS = 4
SHARPENED, DISTINGUISHED = 4, 3  # starts of the search
TRACE = 0.02  # of v_max: a binary signal smaller than this is left out
CLOSEST = 1  # rivals of each truth that one optimisation looks at
HOPELESS = 0.1  # log(1 + χ²) below which two rivals are as good as one model
RIPPLES = (0.0, 0.3)  # share of the voltage for a binary signal on top of a candidate
DRAWS = 66  # of the parameters, for the check of the limits, with them from both places where a rival stands
SMOOTH = 1e-2  # of the largest speed: width of sgn while the voltage is sought
NEARLY = 0.05  # nats between coarse and fine integration that need no further search
ROUGH, TOLERANCE = 3e-4, 1e-5  # of the integration, over the largest state: while the voltage is sought, and after
NO_RECORD = "no record stays within the limits with all models; allow more voltage, current or angle."
WORTH = 4.0  # nats between two rivals from which they count as distinguished


@dataclass(frozen=True, eq=False, repr=False)
class Design(Printed):
    """An experiment designed to distinguish models or to sharpen parameters."""

    goal: str  # "distinguish" or "sharpen"
    excite: str  # what to play: mi.record(port, "next.csv", excite=design.excite)
    t: Array  # (N,), s, and the voltage, rounded as the bench plays it:
    v: Array  # (N,), V
    predicted: Mapping[str, Mapping[str, Array]]  # per rival and channel (N,), SI, and
    band: Mapping[str, Mapping[str, Array]]  # two standard deviations of it, noise included
    # Expected nats by (truth, rival, refitted), with the best fixed candidate and with this one; expected standard
    # deviation, SI, by rival and free parameter, so far and with either.
    evidence: Mapping[tuple[str, str], tuple[float, float]]
    deviations: Mapping[str, Mapping[str, tuple[float, float, float]]]
    peaks: Mapping[str, float]  # largest sizes in any rival, uncertain parameters included, and
    limits: Mapping[str, float]  # their limits; by v, i, omega, theta, dT
    fixed: str  # the best fixed candidate, scaled to the same limits: its name, and
    v_fixed: Array  # its voltage, V
    status: str  # "designed", or "stopped early": the best so far

    @property
    def text(self) -> str:
        """What to expect of it."""
        long = f"This record of {self.t[-1] - self.t[0]:.3g} s"
        if self.goal == "sharpen":
            return f"{long} is expected to sharpen the parameters as below."
        if weak := sorted({tuple(sorted(pair)) for pair, (_, nats) in self.evidence.items() if nats < WORTH}):
            pairs = "; ".join(" and ".join(pair) for pair in weak)
            return f"No record of this length within the limits is expected to distinguish {pairs}."
        names = ", ".join(dict.fromkeys(n for pair in self.evidence for n in pair))
        return f"{long} is expected to distinguish {names}."

    def card(self) -> Card:
        """Return what is expected of it, and how to play it."""
        if self.evidence:
            rows = [[a, b, number(fixed, 3), number(mine, 3)] for (a, b), (fixed, mine) in self.evidence.items()]
            heads = ["if it is", "evidence against", f"by the {self.fixed}, nats", "by this, nats"]
            expected = Table(heads, rows, left=(0, 1))
        else:
            rows = [[name, *(number(x, 3) for x in each)]
                    for every in self.deviations.values() for name, each in every.items()]
            expected = Table(["parameter", "std (SI) so far", f"with the {self.fixed}", "with this"], rows)
        unit = {"dT": "K"} | {c: units[0] for c, units in UNITS.items()}
        rows = [["temperature rise" if c == "dT" else channel_name(c), quantity(p, unit[c], 3),
                 quantity(self.limits.get(c), unit[c], 3)] for c, p in self.peaks.items()]
        return Card("Designed experiment", (Flag(self.status, "good" if self.status == "designed" else "note"),),
                    (self.text, f"Play it: {self.excite}"),
                    (expected, Table(["quantity", "largest expected", "limit"], rows)),
                    (("mi.plot_design(design)", "see it"), ('design.to_csv("plan.csv")', "time and voltage"),
                     ('mi.record(port, "next.csv", excite=design.excite)', "play it")))

    def to_csv(self, path: str | Path, force: bool = False) -> Path:
        """Write time, voltage, and what each rival predicts; over another program's file with `force` only."""
        heads = ["t_s", "v_V", *(f"{c}_{n}" for n, p in self.predicted.items() for c in p)]
        columns = [self.t, self.v, *(y for p in self.predicted.values() for y in p.values())]
        text, lead = StringIO(), "# Written by motorid\n"
        np.savetxt(text, np.column_stack(columns), "%.7g", ",", header=",".join(heads), comments=lead)
        return write_files({Path(path): text.getvalue()}, force)[0]

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of ``design --json``."""
        return {"goal": self.goal, "status": self.status, "text": self.text, "excite": self.excite,
                "evidence": [{"truth": a, "rival": b, "fixed": f, "designed": d}
                             for (a, b), (f, d) in self.evidence.items()],
                "std": {n: {p: {"before": a, "fixed": f, "designed": d} for p, (a, f, d) in every.items()}
                        for n, every in self.deviations.items()},
                "peaks": dict(self.peaks), "limits": dict(self.limits), "fixed": self.fixed}


@parallel.one_thread
def design_experiment(found: Diagnosis | Fit | Sequence[Fit | Rival], *, goal: str | None = None,
                      parameters: Sequence[str] | None = None, v_max: float | None = None, i_max: float | None = None,
                      omega_max: float | None = None, theta_range: tuple[float, float] | None = None,
                      temp_max: float | None = None, duration: float | None = None, dt: float | None = None,
                      shape: str = "steps", levels: int = LEVELS, slew: float | None = None,
                      budget: float | None = None, progress: Callable[[str], None] | None = None) -> Design:
    """Design the voltage that best distinguishes rival models, or that best sharpens parameters.

    Distinguishing is T-optimal (Atkinson & Fedorov, Biometrika 62, 1975): log(1 + χ²) of the rival that comes nearest
    to the truth, refitted to all records, in the mean over the rivals as truths, up to where more is worth nothing
    (compound: Ponce de Leon & Atkinson, Biometrika 78, 1991). The truth lies anywhere within two standard deviations
    of its values, or as fitted where that would hide the difference; an effect that the records leave open is as large
    as they allow. Sharpening is D_s-optimal for one parameter (Fedorov, Theory of Optimal Experiments, 1972); for more,
    the product of their variances by the Fisher information, that of the records so far included. Both are an NLP, by
    sequential linear programming with exact derivatives of the discrete step, from fixed candidates and, to sharpen,
    waves at the limit of current or speed; limits hold for every rival, and for drawn parameters by a smaller voltage.

    It is a local optimum, as good as the rivals: where all are wrong, neither gain nor limits are guaranteed.

    Parameters
    ----------
    found : Diagnosis, Fit or sequence of Fit
        A diagnosis, or the rivals themselves, fitted to the same records.
    goal : {"distinguish", "sharpen"}, optional
        By default to distinguish where there are rivals.
    parameters : sequence of str, optional
        To sharpen; by default all that are free.
    v_max, i_max, omega_max : float, optional
        Limits, V, A, rad/s; by default the largest in the records.
    theta_range : (float, float), optional
        rad, the start at zero.
    temp_max : float, optional
        Rise of the winding's temperature, K; needs a rival with `winding_heating`.
    duration, dt : float, optional
        s; by default those of the longest record, and of the samples.
    shape : {"steps", "free", "multisine"}
        Steps, ramps between free levels, or ramps along a sum of sines.
    levels : int
        Number of segments of the voltage; a bench has a limit.
    slew : float, optional
        Largest slope of ramps, V/s.
    budget : float, optional
        s after which the best so far is taken; Ctrl-C does the same.
    progress : callable, optional
        Called with a word on what was done.

    Raises
    ------
    UsageError, FitError
        For words, names or limits that make no sense; if no record within the limits can be found.

    Examples
    --------
    >>> plan = mi.design_experiment(better, parameters=["b"], v_max=12, i_max=8, duration=0.5, levels=4)
    >>> words = plan.excite  # for `motorid record --excite`
    """
    positive(OMITTED, v_max=v_max, i_max=i_max, omega_max=omega_max, temp_max=temp_max, duration=duration, dt=dt)
    at_least(0, budget=budget)
    rivals, goal = _rivals(found, goal)
    asked = tuple(chosen(parameters, rivals[0].model.free_names, "free parameter")) if goal == "sharpen" else ()
    if parameters and goal != "sharpen":
        raise UsageError("parameters are sharpened, and rivals distinguished: say goal='sharpen', or leave them out.")
    if goal == "sharpen" and not asked:
        raise UsageError("the model has no free parameter to sharpen; free some with model.free(…).")
    _check_words(shape, levels, slew)
    seen = rivals[0].seen
    dt, duration = float(f"{dt or seen['dt']:.9g}"), duration or seen["duration"]
    _check_span(duration, dt)
    limits = _limits(rivals, v_max or seen["v"], i_max, omega_max, theta_range, temp_max)
    layout = _layout(shape, levels, duration, max(dt, 0.5 * duration / SAMPLES), limits["v"][1])
    with parallel.progress("Designing", 1 + (SHARPENED if asked else DISTINGUISHED), at_most=True) as advance:
        def say(word: str) -> None:
            _ = advance(1, f"Designing: {word.partition(':')[0]}"), progress and progress(word)

        whole = _task(rivals, layout, {s: x for s, x in limits.items() if s != "v"}, asked, slew)
        task = _judged(whole)
        name, plain = _fixed(task)
        fine = _exact(replace(plain.task, pairs=whole.pairs), rivals).refined(plain.task.layout.of(plain.c), TOLERANCE)
        fixed = name, fine, _safe(fine, plain.c)[0]
        say("compared fixed candidates")
        with parallel.budget(budget):
            best = _optimised(task, say)
        task, layout = _exact(replace(best.task, pairs=whole.pairs), rivals), best.task.layout
        bits = np.append(np.zeros(len(best.c) // 2), layout.bits)  # of the unknowns, which begin with the levels
        c = best.c if layout.ramps else np.where((bits > 0) & (np.abs(best.c) < TRACE), 0.0, best.c)
        c, peaks = _safe(task.refined(layout.of(c), TOLERANCE), c)
        return _told(task.refined(layout.of(c), TOLERANCE), c, peaks, fixed, limits,
                     "stopped early" if best.stopped else "designed")


def _optimised(task: Task, say: Callable[[str], None]) -> Found:
    """Return the best point that the search reaches from the best starts."""
    done: list[Found] = []
    for name, coarse in list(_starts(task).items())[:SHARPENED if task.asked else DISTINGUISHED]:
        if (start := _within(coarse.task, coarse.c)) is None:
            continue
        found = climb(_hardest(start.task, start.c), start.c)
        again = _within(replace(found.task, pairs=task.pairs), found.c)  # integration steps that suit what was found
        if again is not None:
            if not found.stopped and abs(again.value - found.value) > NEARLY:
                found = climb(_hardest(again.task, again.c), again.c)
                again = _within(replace(found.task, pairs=task.pairs), found.c) or again
            found = replace(again, stopped=found.stopped)
        done.append(found)
        say(f"optimised from the {name}: {found.value:.3g}")
        if found.stopped or found.value > task.enough - NEARLY:
            break
    if not done:
        raise FitError(NO_RECORD)
    return max(done, key=lambda f: f.value)


def _judged(task: Task) -> Task:
    """Return the task without the pairs that no fixed candidate distinguishes, if there are others."""
    kept = [_shrunk(task, c) for c in _followed(task.layout, (0.0,)).values()] if task.pairs else []
    if not (every := [task.layout.of(k[0]) for k in kept if k is not None]):
        return task

    def hopeless(task: Task) -> frozenset[tuple[int, int]]:
        worth = [[w.value for w in task.criteria(levels, task.respond(levels), False)] for levels in every]
        return frozenset(p for p, w in zip(task.pairs, np.max(worth, axis=0), strict=True) if w <= HOPELESS)

    task = replace(task, nominal=hopeless(task))
    never = hopeless(replace(task, pairs=tuple(task.nominal))) if task.nominal else ()
    return replace(task, pairs=tuple(p for p in task.pairs if p not in never) or task.pairs)


def _hardest(task: Task, c: Array) -> Task:
    """Return the task with those pairs alone of each truth that are hardest to distinguish."""
    if not task.pairs:
        return task
    levels = task.layout.of(c)
    worth = [w.value for w in task.criteria(levels, task.respond(levels), False)]
    return replace(task, pairs=tuple(task.pairs[k] for each in task.truths
                                     for k in sorted(each, key=lambda k: worth[k])[:CLOSEST]))


def _rivals(found: Any, goal: str | None) -> tuple[list[Rival], str]:
    """Return the rivals, and whether they are to be distinguished."""
    fits = list(found.rivals) if isinstance(found, Diagnosis) else [found] if isinstance(found, Fit) else list(found)
    goal = goal or ("distinguish" if len(fits) > 1 else "sharpen")
    among(goal, GOALS, "goal")
    if goal == "distinguish" and len(fits) < 2:
        raise UsageError("to distinguish models takes at least two of them: what was found has no group, or give the "
                         'fits of the rivals. A single fit can be sharpened: goal="sharpen".')
    if goal == "sharpen" and isinstance(found, Diagnosis):
        fits = [found.best]
    if not fits:
        raise UsageError("an experiment is designed for models: give a diagnosis or at least one fit.")
    as_rival = Rival.as_allowed if goal == "distinguish" else Rival.of
    rivals = [f if isinstance(f, Rival) else as_rival(f) for f in fits[:MOST_RIVALS if goal == "distinguish" else 1]]
    return [replace(r, name=n) for r, n in zip(rivals, names_apart([r.model for r in rivals]), strict=True)], goal


def names_apart(models: Sequence[Model]) -> list[str]:
    """Return the effects of each model that not all of them have."""
    common = set.intersection(*(set(m.effect_names) for m in models)) if len(models) > 1 else set()
    return [" + ".join(n for n in m.effect_names if n not in common) or "none" for m in models]


def _check_span(duration: float, dt: float) -> None:
    if not 10 * dt <= duration <= min(LONGEST, MOST_SAMPLES * dt):
        raise UsageError(f"an experiment takes {LONGEST:g} s at most, and from ten to {MOST_SAMPLES:g} samples; dt is "
                         f"{dt:g} s, the duration {duration:g} s.")


def _check_words(shape: str, levels: int, slew: float | None) -> None:
    among(shape, SHAPES, "shape")
    if not 2 <= levels <= MOST_SEGMENTS:
        raise UsageError(f"levels must lie between 2 and {MOST_SEGMENTS}; got {levels}.")
    if slew is not None and (shape == "steps" or not slew > 0):
        raise UsageError('slew limits ramps, in V/s above zero; steps jump. Use shape="free" with it.')


def _limits(rivals: Sequence[Rival], v_max: float, i_max: float | None, omega_max: float | None,
            theta_range: tuple[float, float] | None, temp_max: float | None) -> dict[str, tuple[float, float]]:
    """Return the limits by state, and of the voltage."""
    seen, found = rivals[0].seen, {"v": (-v_max, v_max)}
    for state, given in (("i", i_max), ("omega", omega_max)):
        if size := given or seen.get(state):
            found[state] = (-size, size)
    if theta_range is not None:
        found["theta"] = theta_range
    if temp_max is not None:
        if not any("winding_heating" in r.model.effect_names for r in rivals):
            raise UsageError("temp_max needs a rival with winding_heating, which knows the winding's heat capacity; "
                             "limit i_max instead.")
        found["dT"] = (-temp_max, temp_max)
    for name, (low, high) in found.items():
        if not low < 0 < high:
            raise UsageError(f"the limits of {name} must lie on both sides of zero; got {low:g} … {high:g}.")
    return found


def _whole(ms: int, dt: float) -> int:
    """Return `ms` or a little more, so that it is a whole number of samples as near as can be."""
    return min(range(ms, ms + 8), key=lambda n: round(abs(n / dt / 1e3 - round(n / dt / 1e3)), 3))


def _layout(shape: str, levels: int, duration: float, dt: float, v_max: float) -> Layout:
    ms = _whole(max(SHORTEST, round(duration * 1e3 / levels)), dt)
    segments = max(2, min(levels, round(duration * 1e3 / ms)))
    quickest = max(1, round(2e3 * dt))
    bits = np.geomspace(quickest, max(ms / 4, quickest), 4).round().astype(int)
    layout = Layout((ms,) * segments, dt, tuple(np.resize(bits, segments).tolist()), None, v_max)
    if shape == "steps":
        return layout
    phase = 2 * np.pi * np.arange(segments + 1) / segments
    tones = np.arange(1, max(2, segments // 4) + 1)
    mixing = np.hstack([np.sin(np.outer(phase, tones)), np.cos(np.outer(phase, tones))])
    return replace(layout, bits=(), mixing=mixing if shape == "multisine" else None)


def _task(rivals: Sequence[Rival], layout: Layout, limits: Mapping[str, tuple[float, float]], asked: tuple[str, ...],
          slew: float | None) -> Task:
    errors = {c: float(np.sqrt(np.mean([r.sigma[c] ** 2 for r in rivals]))) for c in rivals[0].sigma}
    width = SMOOTH * limits["omega"][1] if asked and "omega" in limits else 0.0  # the rivals may differ at low speed
    driven = tuple(Driven.of(r.smoothed(width), layout, errors, "theta" in limits) for r in rivals)
    pairs = () if asked else tuple(permutations(range(len(rivals)), 2))
    return Task(driven, limits, errors, asked, pairs, slew or np.inf)


def _starts(task: Task) -> dict[str, Found]:
    """Return starts by name, each in its own layout and within the limits; the best first."""
    laid = {} if task.layout.ramps or not task.asked else _waves(task)
    laid |= {n: (task.layout, c) for n, c in _followed(task.layout, RIPPLES).items()}
    found = _best_first({n: _within(task.laid(layout), c, bool(task.asked)) for n, (layout, c) in laid.items()})
    kinds = {n.split(" + ")[0]: n for n in reversed(found)}  # the best of each, which comes last
    return {n: f for n, f in found.items() if n in kinds.values()}


def _best_first(found: Mapping[str, Found | None]) -> dict[str, Found]:
    """Return what is there, the best first; of those that tell enough, the gentlest."""
    there = {n: f for n, f in found.items() if f is not None}
    power = {n: float(np.mean(f.task.layout.voltage(f.task.layout.of(f.c)) ** 2)) for n, f in there.items()}
    return {n: there[n] for n in sorted(there, key=lambda n: (-there[n].value, power[n]))}


def _followed(layout: Layout, ripples: Sequence[float]) -> dict[str, Array]:
    """Return the unknowns that follow the fixed candidates, by their names."""
    found = {}
    t = np.linspace(0, layout.dt * (layout.edges[-1] - 1), layout.edges[-1])
    for name, (v, _) in candidates(t, 1.0).items():
        if layout.ramps:
            c = v[np.append(layout.edges[:-1], len(t) - 1)]
            found[name] = c if layout.mixing is None else np.linalg.lstsq(layout.mixing, c, rcond=None)[0]
            continue
        c = np.array([part.mean() for part in np.split(v, layout.edges[1:-1].tolist())])
        for share in ripples:
            found[f"{name} + PRBS" if share else name] = np.concatenate([(1 - share) * c, np.full(len(c), share)])
    return found


SPEEDS = {"reversals": (1.0, -1.0), "slower reversals": (0.5, -0.5), "fast and slow": (1.0, 0.08),
          "fast and slow, both ways": (1.0, 0.08, -1.0, -0.08)}
NEAR = 0.95  # share of a limit at which a wave is drawn


def _waves(task: Task) -> dict[str, tuple[Layout, Array]]:
    """Return waves that stand at the limits: layouts of ramps and steps with binary signals, and their unknowns.
    Between two speeds the current is at its limit (a jump of the voltage, then a ramp with the back-EMF)."""
    old, found = task.layout, {}
    total, most = sum(old.ms), len(old.ms)
    quick = max(1, round(2e3 * old.dt))
    bits = sorted({max(quick, round(b)) for b in np.geomspace(quick, max(total / 60, quick), 6)})
    for bit in bits:
        n = min(most, max(1, round(total / (60 * bit))))
        layout = replace(old, ms=tuple(_split(old, n)), bits=(bit,) * n)
        found[f"binary signal of {bit} ms"] = layout, np.concatenate([np.zeros(n), np.ones(n)])
    values = task.driven[0].rival.model.values
    if not {"R", "K", "J", "b"} <= values.keys() or not {"i", "omega"} <= task.limits.keys():
        return found
    for name, speeds in SPEEDS.items():
        for n in sorted({min(k, most // 2) for k in (2, 4, 8, most)}):  # each takes a ramp and a step
            for bit, ripple in ((0, 0.0), *((b, r) for b in bits[::2] for r in (0.15, 0.4))):
                wave = _between(task, values, [speeds[k % len(speeds)] for k in range(n)], bit, ripple)
                if wave is not None:
                    found[f"{name} ({n})" + f" + {ripple:g} at {bit} ms" * bool(bit)] = wave
    return found


def _split(layout: Layout, n: int) -> list[int]:
    """Return n lengths, ms, of whole samples, that share the record."""
    unit = _unit(layout)
    return [unit * int(k) for k in np.diff(np.round(np.linspace(0, sum(layout.ms) // unit, n + 1)))]


def _unit(layout: Layout) -> int:
    """Return the least ms that are whole samples, as near as can be."""
    return _whole(max(1, int(np.ceil(1e3 * layout.dt - 1e-6))), layout.dt)


def _between(task: Task, values: Mapping[str, float], speeds: Sequence[float], bit: int,
             ripple: float) -> tuple[Layout, Array] | None:
    """Return the wave that goes from one share of the largest speed to the next and stays there."""
    R, K, J, b = (values[n] for n in ("R", "K", "J", "b"))
    V, I = task.layout.v_max, NEAR * task.limits["i"][1]
    top = NEAR * min(task.limits["omega"][1], V / (K + R * b / K))
    unit, w, segments = _unit(task.layout), 0.0, []  # segments: ms, ms per bit, first and second level
    for share, length in zip(speeds, _split(task.layout, len(speeds)), strict=True):
        if (need := 1e3 * J * abs(share * top - w) / (K * I)) < unit or length < unit:
            return None
        go = min(length, unit * round(need / unit))
        to = w + (share * top - w) * min(1.0, length / need)
        push, stays = R * I * np.sign(share * top - w), length - go > max(bit, 1)
        segments.append((go if stays else length, 0, push + K * w, push + K * to))
        if stays:
            segments.append((length - go, max(bit, 1), (K + R * b / K) * to, ripple * V))
        w = to
    ms, bits, first, second = zip(*segments, strict=True)
    c = np.clip(np.array([*first, *second]) / V, -1, 1)
    n, on = len(ms), np.array(bits) > 0
    c[n:][on] = np.minimum(c[n:][on], 1 - np.abs(c[:n][on]))
    return replace(task.layout, ms=ms, bits=bits), c


def _within(task: Task, c: Array, fine: bool = True) -> Found | None:
    """Return the task (of fine steps) and unknowns, shrunk until the limits hold; None where they never do."""
    if (kept := _shrunk(task, c)) is not None and fine:
        task = task.refined(task.layout.of(kept[0]), ROUGH)
        kept = _shrunk(task, kept[0])
    if kept is None:
        return None
    levels = task.layout.of(kept[0])
    worth = np.array([w.value for w in task.criteria(levels, task.respond(levels), False)])
    return Found(task, kept[0], task.worth(worth))


def _shrunk(task: Task, c: Array, displaced: Sequence[Array] = (),
            ) -> tuple[Array, dict[str, tuple[float, float]]] | None:
    """Return the unknowns, shrunk until (displaced) rivals keep the limits, and their reach; None: they never do."""
    c = nearest(task, c)
    for _ in range(30):
        reach = task.reach(task.layout.of(c), displaced or [np.zeros((1, len(d.rival.scale))) for d in task.driven])
        rooms = {s: task.room(s) for s in reach}
        if (ratio := max(max(reach[s][0] / low, reach[s][1] / high) for s, (low, high) in rooms.items())) <= 1:
            return c, reach
        c = c * min(0.98, max(1 / ratio, 0.3))
    return None


def _exact(task: Task, rivals: Sequence[Rival]) -> Task:
    """Return the task with the rivals as they were fitted."""
    return replace(task, driven=tuple(replace(d, rival=r) for d, r in zip(task.driven, rivals, strict=True)))


def _fixed(task: Task) -> tuple[str, Found]:
    """Return the best fixed candidate within the same limits, by its name and in many steps."""
    old = task.layout
    ms = _whole(max(1, round(sum(old.ms) / FINE)), old.dt)
    n = round(sum(old.ms) / ms)
    fine = task.laid(replace(old, ms=(ms,) * n, bits=(ms,) * n, mixing=None))
    if not (starts := _best_first({n: _within(fine, c) for n, c in _followed(fine.layout, (0.0,)).items()})):
        raise FitError(NO_RECORD)
    return next(iter(starts.items()))


def _safe(task: Task, c: Array) -> tuple[Array, dict[str, float]]:
    """Return the unknowns, shrunk until drawn parameters keep the limits too, and the largest size of each state."""
    rng = np.random.default_rng(0)
    if (kept := _shrunk(task, c, [d.rival.draws(DRAWS, rng) for d in task.driven])) is None:
        raise FitError(NO_RECORD)
    c, reach = kept
    return c, {"v": float(np.abs(task.layout.of(c)).max()), **{s: max(-a, b) for s, (a, b) in reach.items()}}


def _expected(task: Task, levels: Array) -> tuple[dict[tuple[str, str], float], dict[str, dict[str, float]]]:
    """Return the evidence per (truth, rival), nats, and the deviations per rival and parameter."""
    answers = task.respond(levels)
    names = [d.rival.name for d in task.driven]
    values = () if task.asked else task.criteria(levels, answers, False)
    evidence = {(names[i], names[j]): 0.5 * float(np.expm1(w.value))
                for (i, j), w in zip(task.pairs, values, strict=True)}
    return evidence, {n: d.rival.deviations(d.informs(r)) for n, d, r in zip(names, task.driven, answers, strict=True)}


def _told(task: Task, c: Array, peaks: Mapping[str, float], fixed: tuple[str, Task, Array],
          limits: Mapping[str, tuple[float, float]], status: str) -> Design:
    """Return the design in the voltage that the bench will play."""
    layout, levels = task.layout, np.round(task.layout.of(c), 3)
    excite, n = layout.words(levels), int(layout.edges[-1])
    predicted, band = {}, {}
    for d, r in zip(task.driven, task.respond(levels), strict=True):
        cov, shown = np.linalg.inv(d.rival.known), [c for c in d.system.outputs if c in task.noise]
        variance = np.einsum("nci,ij,ncj->nc", r.dy, cov, r.dy) + 1
        predicted[d.rival.name] = {s: r.y[:n, k] * d.errors[k] for k, s in enumerate(shown)}
        band[d.rival.name] = {s: 2 * np.sqrt(variance[:n, k]) * d.errors[k] for k, s in enumerate(shown)}
    name, fine, at = fixed
    evidence, deviations = _expected(task, levels)
    old_evidence, old_deviations = _expected(fine, fine.layout.of(at))
    return Design(
        "sharpen" if task.asked else "distinguish", excite, np.linspace(0, layout.dt * (n - 1), n),
        program(excite).volts(1 / layout.dt), predicted, band, {p: (old_evidence[p], e) for p, e in evidence.items()},
        {d.rival.name: {p: (s, old_deviations[d.rival.name][p], deviations[d.rival.name][p])
                        for p, s in d.rival.deviations(d.rival.known).items()} for d in task.driven},
        peaks, {s: max(abs(low), abs(high)) for s, (low, high) in limits.items()}, name,
        fine.layout.voltage(fine.layout.of(at))[:-1], status)
