"""The answer in words: what is missing, how large, how sure, what the records do not distinguish, what moved."""

import itertools
import re
from collections.abc import Mapping, Sequence

import numpy as np

from motorid.channels import channel_name
from motorid.diagnosis.adequacy import fine_angle_remark
from motorid.diagnosis.admissibility import certain
from motorid.diagnosis.misspecification import IN_ITS_PLACE, Grade
from motorid.diagnosis.model_comparison import Node, far, rarity, share_removed
from motorid.diagnosis.results import Adequacy, Candidate, Rung
from motorid.diagnosis.score_test import Score
from motorid.diagnosis.thresholds import ELSEWHERE, LARGER, LOST, MATERIAL, MOST, TRIFLE, UNCONTESTED
from motorid.display.numbers import arrow, counted, factor, listed, percent, quantity, with_error
from motorid.effects import OTHER
from motorid.estimation.result import Fit, parameter_cell
from motorid.model.model import SHOWN
from motorid.numerics.autoregression import colour_of
from motorid.numerics.signals import despiked, gather
from motorid.problem.runs import angle_signal
from motorid.problem.simulate import moving

MOVED = 0.1  # relative change of a motor parameter that is worth a word
SPIKED = 0.5  # of a channel's squared error: what outliers must make to be worth a word
NOISELESS = 0.1  # of its fast changes: what of a voltage its own past does not tell
RPM = 30 / np.pi
OPEN = " not determined"
DECIDED = "blocks left out of the fitted runs decided"


def first_answer(fit: Fit, judged: Adequacy, scores: Sequence[Score]) -> str:
    """Return what a look without any refit says: whether the model fits, and what to try first."""
    likely = "" if judged.adequate else _promising({s.effect.name: s.drop for s in scores})
    return f"first answer: {fit.verdict}{likely}"


def _promising(drops: Mapping[str, float]) -> str:
    """Say which effects to try first; empty for none."""
    likely = ", ".join(f"{name} ({percent(drop, 2)})" for name, drop in list(drops.items())[:3] if drop > 0)
    return f" Most promising, by the share of the squared error that they would remove: {likely}." if likely else ""


def adequate_text(judged: Adequacy, ranking: Sequence[Candidate], last: Fit) -> tuple[str, str]:
    """Return the answer when nothing is missing, of the last model, and how many effects were tried."""
    tried = f"{judged.text} None of the {len(ranking)} effects tried is worth adding." if ranking else judged.text
    if far(last):
        why = judged.hum or "they fluctuate by themselves, or the noise is slow"
        return f"Nothing that depends on the motion is missing, but the errors are larger than the noise: {why}.", tried
    if last.mostly_noise:
        return "These records are mostly noise: nothing that is missing would show in them.", tried
    if judged.p_value <= judged.false_alarm:
        return "Nothing that matters is missing: the errors are within the noise.", tried
    return "Nothing is missing: the errors do not depend on the motion.", tried


def unexplained_text(ranking: Sequence[Candidate], rungs: Sequence[Rung], grades: Sequence[Grade], like: str,
                     remaining: Adequacy, curve: str = "", *, errors: Mapping[str, float] | None = None,
                     whole: bool = True, done: bool = True) -> str:
    """Return the answer when something is missing that the library does not have; `curve`: what it does as one. That
    leads where it leaves, with these `errors`, next to nothing of what effects leave that together come close.

    Not `whole`: only some effects were asked for. Not `done`: the search was stopped before all of these were tried."""
    none = "no effect of the library" if whole else "none of the effects asked for"
    lead = f"Unexplained: {like}, which {none} describes." if like else (
        "Something is missing, and these records do not show what." if grades and remaining.adequate else
        f"Unexplained: something is missing, and {none} explains it.")
    if not done:
        lead = f"Unexplained so far: {like or 'something is missing'}; not all effects were tried."
        lead += "" if grades else _promising({c.effect: c.predicted_drop for c in ranking})
    if grades:
        near, share, nearest = _nearest(rungs, grades, ranking)
        whole_share = share_removed(*(r.validation_nrmse or r.nrmse for r in (rungs[0], rungs[-1])))
        last = rungs[-1].validation_nrmse or rungs[-1].nrmse
        led = errors and errors.keys() >= moving(last).keys() and share_removed(last, errors) > UNCONTESTED
        if not near and whole_share > MOST and grades[1:] and not led:
            titles, share = listed([_titled(rungs[-1].fit, g.effect) for g in grades]), whole_share
            near = f"{titles}, which together remove {percent(share, 2)} of the squared error"
        better = f"; better still is {like}, which {none} describes" if like else ""
        lead, near = (f"Unexplained, but close to {near}{better}.", "") if near and done and share > MOST else (
            lead, near and f"Nearest: {near}.")
        helps = approximations_text([g for g in grades if g not in nearest or not g.why.startswith("it removes")])
        for form in (g.form for g in grades if g.form):  # in few words, and another may lead when fitted
            helps = helps.replace(IN_ITS_PLACE.format(form.text), "a free curve predicts better")
        left = _left(rungs[-1].fit, remaining).replace(f" They follow {like}.", "")  # said already
        return " ".join(t for t in (lead, curve, near, helps, errors_text(rungs), left) if t)
    lead = f"{lead} {curve}".rstrip()
    best = max((c for c in ranking if c.refit_drop is not None), key=lambda c: c.refit_drop or 0.0, default=None)
    if best is None or (best.refit_drop or 0) <= 0.05:
        return lead
    return (f"{lead} The nearest, '{best.effect}', removes {percent(best.refit_drop, 2)} of the squared error, but "
            f"was not added: {best.reason}.")


def _nearest(rungs: Sequence[Rung], grades: Sequence[Grade],
             ranking: Sequence[Candidate]) -> tuple[str, float, list[Grade]]:
    """Return in words what came with the largest fall of the error, the share of the squared error that it removes with
    what it took the place of, and its grades; where its sizes are open, what alone does nearly as much, determined."""
    shares = dict[str, float]()
    for k, rung in enumerate(rungs):
        left = 1 - share_removed(*(r.validation_nrmse or r.nrmse for r in (rungs[max(k - 1, 0)], rung)))
        share = 1 - left * float(np.prod([1 - s for s in {shares.get(n, 0.0) for n in rung.removed}]))
        shares |= dict.fromkeys((rung.added or "").split(" + "), share)
    share = max((shares.get(g.effect, 0.0) for g in grades), default=0.0)
    nearest = [g for g in grades if shares.get(g.effect, 0.0) == share]
    if share <= (0.0 if any(g.form for g in grades) else MOST):
        return "", share, []
    said = " with ".join(_described(rungs[-1].fit, g.effect) for g in nearest) + _alike(ranking, nearest, grades)
    removes = "removes" if len(nearest) == 1 else "remove"
    if any(OPEN in text for text in (said, *(g.why for g in nearest))):
        others = [(rarity(c.effect), drop, _described(c.fit, c.effect)) for c in ranking
                  if c.fit and (drop := c.refit_drop or 0.0) > UNCONTESTED * share and not c.fit.per_run
                  and ", but " not in c.reason and all(c.effect != g.effect for g in grades)]
        if known := [other for other in others if OPEN not in other[2]]:
            left = (1 + TRIFLE) * (1 - max(drop for _, drop, _ in known))  # of what leaves hardly more, the commonest
            _, share, said = min((other for other in known if 1 - other[1] <= left), key=lambda other: other[0])
            removes, nearest = "alone removes", []
        elif any(g.form for g in grades):
            return "", share, []
    return f"{said}, which {removes} {percent(share, 2)} of the squared error", share, nearest


def _alike(ranking: Sequence[Candidate], nearest: Sequence[Grade], grades: Sequence[Grade]) -> str:
    """Return what leaves hardly more of the squared error than the nearest effect did alone, the commonest first."""
    left = {c.effect: 1 - c.refit_drop for c in ranking if c.refit_drop is not None and ", but " not in c.reason}
    most = (1 + TRIFLE) * left.get(nearest[0].effect, 0.0) if len(nearest) == 1 else 0.0
    others = sorted(left.keys() - {g.effect for g in grades}, key=lambda name: (rarity(name), name))
    alike = [name for name in others if left[name] < most][:3]
    return f" (as near: {listed(alike, 'or')})" if alike else ""


def approximations_text(grades: Sequence[Grade], what: str = "it") -> str:
    """Say which effects help without being the thing itself, `what`, and why."""
    reasons: dict[str, list[str]] = {}
    for g in grades:
        if g.grade == "approximates":
            reasons.setdefault(g.why, []).append(f"'{g.effect}'")
    return " ".join(
        f"{listed(names)} help, but only approximate {what}: {why.replace('it removes', 'each removes', 1)}."
        if len(names) > 1 else f"{names[0]} helps, but only approximates {what}: {why}."
        for why, names in reasons.items())


def missing_text(rungs: Sequence[Rung], remaining: Adequacy, groups: Sequence[Sequence[str]],
                 grades: Sequence[Grade], elsewhere: bool = False, stopped: str = "") -> str:
    """Return the answer when effects were found: what, how large, what the error becomes, what remains. `elsewhere`:
    held-out runs are predicted far worse than the fitted ones. `stopped`: why before all were tried."""
    after = rungs[-1].fit
    names, (near, share, nearest) = [g.effect for g in grades if g.grade != "approximates"], _nearest(rungs, grades, ())
    first = [f"something close to {near}"] * (share > MOST and {g.grade for g in nearest} == {"approximates"})
    lead = f"Missing so far ({stopped})" if stopped else "Missing"
    parts = [f"{lead}: {'; '.join([*first, *(_described(after, n) for n in names)])}."]
    parts += [f"These records do not distinguish {g[0]} from {' or '.join(g[1:])}." for g in groups]
    parts += [approximations_text(grades, "the rest")] if len(names) < len(grades) else []
    parts += [errors_text(rungs), _left(after, remaining, " on the fitted runs, not on the held-out ones" * elsewhere)]
    return " ".join(parts)


def _left(last: Fit, remaining: Adequacy, where: str = "") -> str:
    """Say what is left beside what was found."""
    if not remaining.adequate:
        return f"Not everything is explained: {remaining.text.removeprefix('Something is missing: ')}"
    if large := [f"{channel_name(c)} {factor(last.misfit[c])} times" for c in far(last)]:
        what = f"for {remaining.hum}" if remaining.hum else "but nothing tried predicts it"
        return f"What remains is larger than the noise ({', '.join(large)}), {what}."
    return f"What remains is noise{where}. {fine_angle_remark(last)}".rstrip()


def _titled(fit: Fit, name: str) -> str:
    title = next(e for e in fit.problem.model.effects if e.name == name).title
    return title if name in title else f"{title} [{name}]"


def _described(fit: Fit, name: str) -> str:
    effect, std = next(e for e in fit.problem.model.effects if e.name == name), certain(fit)
    said = [_titled(fit, name)]
    for p in effect.parameters:
        now, sd = fit.problem.model.parameters[p.name], std.get(p.name)
        known = sd is not None or not now.vary
        text = f"{p.name} = {with_error(fit.values[p.name], sd, now.unit)}" if known else f"{p.name}{OPEN}"
        if p.name in fit.per_run:
            text = f"{p.name} = {parameter_cell(fit, p.name)}"
        if not known and (volts := fit.determined.get(f"{p.name}_voltage")) is not None:
            text = f"{volts.text.rpartition(', ')[2]} = {with_error(volts.value, volts.std, volts.unit)}"
        if p.name == "k_w" and abs(1 + fit.values[p.name] - RPM) < 0.3:
            text += ", the ratio of rpm to rad/s: the speed is probably in rpm"
        said.append(text)
    return ", ".join(said)


def errors_text(rungs: Sequence[Rung]) -> str:
    """Say how the error changed, on held-out runs where there are any: what fell, then what rose and why."""
    last = rungs[-1]
    was, is_ = (moving(r.validation_nrmse or {}) for r in (rungs[0], last))
    held_out = bool(was and is_)
    was, is_ = (was, is_) if held_out else (moving(rungs[0].nrmse), moving(last.nrmse))
    noise = {c for c in was if last.fit.misfit.get(c, 0.0) < LARGER}
    words = [_changed(c, was[c], is_[c]) for c in sorted(was, key=lambda c: is_[c] > was[c])]
    noisy = tuple(f"{channel_name(c)} rises" for c in noise)
    said = [w + " (mostly noise)" * w.startswith(noisy) for w in words]
    text = f"{'Held-out error' if held_out else 'Error'}: {', '.join(said)}."
    if held_out and (lost := [c for c, e in was.items() if min(e, is_[c]) > LOST]):
        return f"{text} Both models lose {listed(lost)} there; {DECIDED}."
    if held_out and share_removed(was, is_) <= 0:
        return f"{text} It does not fall over all channels; {DECIDED}."
    if any(is_[c] > was[c] * (1 + MATERIAL) for c in was if c not in noise):
        text += f" Over all channels it falls by {percent(1 - np.sqrt(1 - share_removed(was, is_)), 2)}."
    return text


def curve_text(rungs: Sequence[Rung], errors: Mapping[str, float], forms: Sequence[tuple[str, float]]) -> str:
    """Say what the `errors` become with a curve, and which of the closed `forms`, the nearest first, it all but is."""
    was = moving(rungs[0].validation_nrmse or rungs[0].nrmse)
    said = ", ".join(_changed(c, e, errors[c]) for c, e in was.items() if c in errors)
    near = "".join(f" The nearest closed form, {text}, misses {'less than ' * (miss < 1e-3)}"
                   f"{percent(max(miss, 1e-3), 2)} of it." for text, miss in forms[:1] if miss < TRIFLE)
    return f"With that as a curve{' on held-out runs' * bool(rungs[0].validation_nrmse)}: {said}.{near}" if said else ""


def rises_text(rungs: Sequence[Rung]) -> str:
    """Say which errors rose from rung to rung and what decided, beside what `errors_text` says; empty if none."""
    told, small = [], set()
    for a, b in itertools.pairwise(rungs):
        there = moving(a.validation_nrmse or {}), moving(b.validation_nrmse or {})
        kinds = [((moving(a.nrmse), moving(b.nrmse)), "fitted"), (there, "held-out")][:1 if len(rungs) == 2 else 2]
        for (was, is_), where in kinds if there[0] or len(rungs) > 2 else ():
            risen = [c for c in was if is_[c] > was[c]]
            large = [_changed(c, was[c], is_[c]) for c in risen if is_[c] > was[c] * (1 + MATERIAL)]
            small |= {channel_name(c) for c in risen if is_[c] <= was[c] * (1 + MATERIAL)}
            told += [f"With '{b.added}' {', '.join(large)} on the {where} runs."] if large else []
        if there[0] and len(rungs) > 2 and share_removed(*there) <= 0:
            told.append(f"With '{b.added}' the held-out error does not fall; {DECIDED}.")
    told += [f"Other rises are below {percent(MATERIAL)} of the error: {', '.join(sorted(small))}."] if small else []
    return " ".join(told)


def _changed(c: str, was: float, is_: float) -> str:
    if (change := arrow(was, is_)) == arrow(is_, was):
        return f"{channel_name(c)} stays {percent(is_)}"
    return f"{channel_name(c)} {'rises ' * (is_ > was)}{change}"


def moves(before: Fit, after: Fit) -> str:
    """Say how the motor's own parameters had compensated for what was missing."""
    free = set(before.problem.model.free_names) & set(after.problem.model.free_names)
    base = [n for n in ("R", "L", "K", "b", "J") if n in free]
    was, is_ = certain(before), certain(after)
    known = [n for n in base if was[n] is not None and is_[n] is not None]
    moved = [n for n in known if abs(after.values[n] / max(before.values[n], 1e-300) - 1) > MOVED]
    units = {n: p.unit for n, p in after.problem.model.parameters.items()}
    said = [f"{n} from {with_error(before.values[n], was[n])} to {with_error(after.values[n], is_[n], units[n])}"
            for n in moved]
    what = "them" if len(after.model.effects) > len(before.model.effects) + 1 else "it"
    return f"Without {what}, other parameters had compensated: {', '.join(said)}." if moved else ""


def measured_angle_remark(fit: Fit) -> str:
    """Say so where effects take the angle from the record, since the model's own drifts too far for them."""
    return ("Effects over the angle use the measured angle, on held-out runs too, because the simulated angle drifts "
            "too far. Without a measured angle this model cannot predict.") if fit.model.angle_input else ""


def own_in_every_run_remark(fit: Fit) -> str:
    """Say so where parameters are others in every run: those of held-out runs are estimated there."""
    are = "are others" if len(fit.per_run) > 1 else "is another"
    return (f"{listed(list(fit.per_run))} {are} in every run, and so estimated in the held-out runs too, for each "
            "block by the others: these prove that it stays, not how large it is.") if fit.per_run else ""


def unfinished_remark(fit: Fit) -> str:
    """Say so where the last fit did not converge: its values, and what is said of them, are not the best there are."""
    text = f"The last fit did not converge ({fit.status}): its values, and this verdict, are provisional."
    return "" if fit.status == "converged" or max(fit.misfit.values(), default=0.0) < LARGER else text


def held_out_remark(node: Node) -> str:
    """Say so where the held-out runs are predicted far worse than the fitted ones, both as a whole."""
    fitted = {} if "part of" in node.fit.problem.experiments[0].meta else node.predictions.blocks
    worse = {c: e.nrmse / max(fitted[c].nrmse, 1e-300) for c, e in node.predictions.held_out.items() if c in fitted}
    said = [f"{c} {factor(r)} times" for c, r in worse.items()
            if r > ELSEWHERE and node.predictions.held_out[c].misfit > LARGER]
    return (f"The error is larger on the held-out runs than on the fitted ones ({', '.join(said)}): the fitted records "
            "do not determine the model there, or another effect acts there.") if said else ""


def inseparable_remark(same: Mapping[str, tuple[str, ...]]) -> str:
    """Say which effects were refused since parameters of the model together do the same."""
    by_parameters: dict[tuple[str, ...], list[str]] = {}
    for name, parameters in same.items():
        by_parameters.setdefault(parameters, []).append(name)
    return " ".join(f"{' or '.join(names)} was not added: these records do not distinguish it from "
                    f"{listed(parameters)}{' together' * (len(parameters) > 1)}."
                    for parameters, names in by_parameters.items())


def unseen_remark(same: Mapping[str, tuple[str, ...]], base: str) -> str:
    """Say which effects these records cannot show, since the motor's own parameters imitate them, and which would."""
    parameters = listed(list(dict.fromkeys(itertools.chain(*same.values()))), "or")
    shown, measured = "it" if len(same) == 1 else "them", listed([channel_name(c) for c in SHOWN[base][:-1]])
    return (f"These records cannot show {listed(list(same), 'or')}: other values of {parameters} do the same. Steps of "
            f"several sizes in both directions, with {measured} measured, are likelier to show {shown}."
            ) if same else ""


def fixed_remark(fits: Sequence[Fit]) -> str:
    """Say what parameters that the user fixed at a value would rather be, each by the first of `fits` that tells."""
    words = []
    for n, effect in OTHER.items():
        if fit := next((f for f in fits if effect.name in f.model.effect_names), None):
            p, sd = fit.model.parameters[n], fit.std.get(f"d_{n}")
            better = with_error(value := p.value * np.exp(fit.values[f"d_{n}"]), sd and sd * value, p.unit)
            words.append(f"{n}, fixed at {quantity(p.value, p.unit)}, may be {better}: model.free('{n}') estimates it.")
    return " ".join(words)


def hidden_remark(hidden: Mapping[tuple[str, str], tuple[str, ...]]) -> str:
    """Say which wider effects than those found do the same with other values of parameters, and what would tell."""
    return " ".join(f"'{wider}' with other values of {listed(parameters)} does the same as '{name}'. To distinguish "
                    f"them, fix one of these where it is known." for (name, wider), parameters in hidden.items())


def exchanged_remark(exchanged: Mapping[str, Fit]) -> str:
    """Say with which other values a lag and the winding's own do the same."""
    return " ".join(f"{n} and L/R may as well be exchanged: {n} = {parameter_cell(fit, n)}, L = "
                    f"{parameter_cell(fit, 'L')} do no worse." for n, fit in exchanged.items())


def outliers_remark(fit: Fit) -> str:
    """Say so when a few samples that stand alone make most of a channel's error: they hide the rest."""
    for c in fit.problem.outputs if fit.problem.loss is None else ():
        parts = [s.residual(c) for s in fit.simulations if c in s.experiment.outputs]
        r = np.concatenate([p[np.isfinite(p)] for p in parts])
        kept = np.concatenate([despiked(p) for p in parts])
        if (spikes := int(np.count_nonzero(r != kept))) and kept @ kept < (1 - SPIKED) * (r @ r):
            share = percent(1 - float(kept @ kept) / float(r @ r), 2)
            turns = [(angle_signal(s.experiment)[known := np.isfinite(p)], p[known] != despiked(p)) for s, p in zip(
                (s for s in fit.simulations if c in s.experiment.outputs), parts, strict=True)
                if "theta" in s.experiment.outputs]
            there = " They gather at angles of a turn: does a wheel lack a tooth?" * gather(turns)
            return (f"{counted(spikes, 'outlier')} (single samples) make{'s' * (spikes == 1)} {share} of the "
                    f"squared error of {c}, and least squares follows. A robust loss (--loss huber, loss=mi.Huber()) "
                    f"shows the rest better.{there}")
    return ""


def closed_loop_remark(fit: Fit) -> str:
    """Say so when a controller made the voltage from the measurement: it hides errors of the model."""
    for run, sim in zip(fit.problem.experiments, fit.simulations, strict=True):
        c = "omega" if "omega" in run.outputs else "theta"
        # What the controller passes on is the measurement, its noise included; a smooth drive follows no noise.
        both = [run.outputs.get(c), sim.residual(c) if c in run.outputs and c in sim.outputs else None]
        feedback = min(_noise_feedback(run.inputs["v"], y) for y in both)
        led = (y for n, y in run.meta.get("extra", {}).items() if re.search("ref|goal", str(n).lower()))
        if feedback > 0.5 or any(len(np.unique(y)) > 1 for y in led):  # what never changes is a sensor's own reference
            return ("The records seem to come from a closed loop: the controller compensates what the model lacks, so "
                    "part of it hides in the voltage, and an open-loop simulation drifts. Open-loop records show it "
                    "better.")
    return ""


def _noise_feedback(v, y) -> float:
    """Correlation of fast changes of the voltage and the last measurement; None where it tells its own next."""
    if y is None or np.ptp(v) == 0:
        return 0.0
    dv, dy = np.diff(v, 2), np.diff(np.nan_to_num(y), 2)
    own = colour_of([dv - dv.mean()])
    calm = np.all([np.abs(d) < 6 * np.median(np.abs(d)) + 1e-300 for d in (dv, dy)], axis=0)
    smooth = np.mean(dv != 0) < 0.5 or own.innovation < NOISELESS * own.variance
    if smooth or calm.sum() < 50 or min(np.ptp(dv[calm]), np.ptp(dy[calm])) == 0:
        return 0.0
    both = [np.corrcoef(dv[1:][calm[1:]], dy[:-1][calm[1:]])[0, 1], np.corrcoef(dv[calm], dy[calm])[0, 1]]
    return float(np.nanmax(np.abs(both)))
