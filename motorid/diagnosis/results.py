"""What a diagnosis found, as plain frozen results."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from motorid.channels import UNITS, channel_name
from motorid.diagnosis.design_criteria import Rival
from motorid.diagnosis.remainder import Remainder
from motorid.display.cards import Card, Cell, Flag, Printed, Shown, Table
from motorid.display.numbers import number, percent, quantity
from motorid.estimation.result import Fit, parameter_table
from motorid.numerics.signals import Array
from motorid.problem.simulate import NRMSE
from motorid.records.experiment import units_of

VERDICT_MOODS = {"adequate": "good", "missing": "note", "unexplained": "bad"}


@dataclass(frozen=True, eq=False, repr=False)
class Adequacy(Shown):
    """Is anything missing at all?"""

    adequate: bool
    p_value: float  # probability of residuals at least this bad from noise alone, coloured noise allowed for
    false_alarm: float  # rate of false alarms of the verdict
    # per channel: "noise" and "rms" of the residual (SI), "ratio" of the two, "autocorrelation" at lag 1, "p_value"
    channels: Mapping[str, Mapping[str, float]]
    text: str
    hum: str = ""  # what predicts errors larger than the noise, and is no motor's, in words

    def card(self) -> Card:
        """Return the verdict, and what it rests on per channel."""
        rows = [[f"{channel_name(c)} {c}", *(quantity(d.get(k), UNITS[c][0], 3) for k in ("noise", "rms")),
                 number(d.get("ratio"), 3), number(d.get("autocorrelation"), 2), number(d.get("p_value"), 2)]
                for c, d in self.channels.items()]
        return Card("Is anything missing?",
                    (Flag("adequate", "good") if self.adequate else Flag("something is missing", "bad"),), (self.text,),
                    (Table(["channel", "noise", "residual", "ratio", "autocorrelation", "p"], rows),),
                    () if self.adequate else (("mi.diagnose(fit)", "what is missing"),))


@dataclass(frozen=True, eq=False)
class Binned:
    """A missing voltage or torque against one quantity: bin centres, mean, and a band of 95 %."""

    against: str
    unit: str
    centre: Array
    mean: Array
    low: Array
    high: Array
    count: Array
    explained: float  # share of the variance that this quantity explains


@dataclass(frozen=True, eq=False, repr=False)
class Missing(Shown):
    """Where the model fails. Per run are time (s), missing voltage (V) and torque (N·m) that would make it match."""

    where: str | None  # "electrical", "mechanical", "sensor", or None
    t: tuple[Array, ...]
    voltage: tuple[Array, ...]
    torque: tuple[Array, ...]
    signals: tuple[Mapping[str, Array], ...]  # per run: i, omega, theta, heat, t at the samples, as far as known
    shares: Mapping[str, float]  # of the misfit by balance: electrical, mechanical, sensor, and
    regions: Mapping[str, float]  # by region: standstill, reversal, acceleration, steady, high current
    bins: Mapping[str, tuple[Binned, ...]]  # "voltage" and "torque" against each signal, the best explanation first
    text: str
    torque_unit: str = "N·m"
    acts_like: str = ""  # what it is like where the library lacks it, e.g. "a load that changes with the angle"

    def card(self) -> Card:
        """Return the shares of balances and regions, and what the missing depends on."""
        best = [[balance, b.against, percent(b.explained, 2)] for balance, bins in self.bins.items() for b in bins[:3]]
        tables = (share_table("balance", self.shares), share_table("region", self.regions),
                  Table(["missing", "depends on", "explained"], best))
        return Card("Where the model fails", (Flag(self.where, "note"),) if self.where else (), (self.text,), tables,
                    (("mi.plot_missing(missing)", "see it"),))


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect (or pair) tried."""

    effect: str  # its name; a pair is "a + b"
    predicted_drop: float  # share of chi² that vanishes, by the sensitivities, and
    refit_drop: float | None = None  # after refitting
    validation_nrmse: Mapping[str, float] | None = None  # held-out errors after refitting
    held_out_gain: float | None = None  # fall of the error on held-out runs, or blocks: geometric mean, spikes aside
    parameters: Mapping[str, float] = field(default_factory=dict)  # of the effect, SI: refitted, or else predicted
    group: tuple[str, ...] = ()  # effects that these records do not distinguish from it
    accepted: bool = False
    reason: str = ""  # why it was taken or not
    gain: float | None = None  # difference of the log predictive density on data left out (nats), and
    gain_se: float | None = None  # its standard error
    fit: Fit | None = field(default=None, repr=False)


@dataclass(frozen=True, eq=False)
class Rung:
    """One step of the ladder: what was added (None: the model to begin with), the fit, its errors."""

    added: str | None
    fit: Fit
    nrmse: Mapping[str, float]  # per channel, on the fitted runs, and
    validation_nrmse: Mapping[str, float] | None  # on the held-out ones
    removed: tuple[str, ...] = ()  # earlier effects that it made superfluous
    candidates: tuple[Candidate, ...] = ()
    grade: str | None = None  # "named", "group" (several tie), "approximates" (`why` says what speaks against it)
    why: str = ""
    gain: float | None = None  # difference of the log predictive density on data left out (nats) from the rung before,
    gain_se: float | None = None  # and its standard error


@dataclass(frozen=True, eq=False, repr=False)
class Ladder(Printed):
    """Models of growing detail, training and held-out error of each, and why it stopped."""

    rungs: tuple[Rung, ...]
    text: str

    @property
    def fits(self) -> tuple[Fit, ...]:
        """The fit of each rung."""
        return tuple(r.fit for r in self.rungs)

    @property
    def best(self) -> Fit:
        """The fit of the last rung."""
        return self.rungs[-1].fit

    def card(self) -> Card:
        """Return the errors rung by rung, and why it stopped."""
        return Card("Ladder of models", text=(self.text,), tables=(ladder_table(self),),
                    after=(("mi.plot_ladder(ladder)", "see it"), ("ladder.best", "the last fit")))


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Shown):
    """The answer to: where does the model fail, and what is missing?

    Attributes
    ----------
    verdict : {"adequate", "missing", "unexplained"}
    text : str
        The answer in words.
    where : {"electrical", "mechanical", "sensor"} or None
    effects : tuple of str
        Effects that are named or one of a group, in order; what only approximates stands in the ladder.
    adequacy, missing, ranking, ladder
        What it rests on; `ranking` is of the first round, best first.
    groups : tuple of tuple of str
        Effects that these records do not distinguish.
    suggestion : str or None
        The experiment that would separate them.
    remaining : Adequacy
        Of the model after the last rung.
    remainder : Remainder or None
        What is left beside all effects: noise, fluctuation or structure, and what structure follows.
    stopped : str
        Why it ended before it was done: the budget was spent, or it was interrupted; empty if it was done.
    answer : str
        The verdict in a few sentences: what is missing and how large, how the error changes, what remains.
    details : tuple of str
        What else a reader should know.
    rivals : tuple of Fit
        The last fit, and those with others of the first group in its effect's place: for an experiment to distinguish.
    """

    verdict: str
    text: str
    where: str | None
    effects: tuple[str, ...]
    adequacy: Adequacy
    missing: Missing
    ranking: tuple[Candidate, ...]
    ladder: Ladder
    groups: tuple[tuple[str, ...], ...]
    suggestion: str | None
    before: Fit
    after: Fit
    remaining: Adequacy
    remainder: Remainder | None = None
    stopped: str = ""
    answer: str = ""
    details: tuple[str, ...] = ()
    rivals: tuple[Fit, ...] = ()

    @property
    def best(self) -> Fit:
        """The fit of the last rung: the model that predicts best."""
        return self.after

    def summary(self) -> Card:
        """Return the answer alone: the verdict, the errors before and after, the next step."""
        flags = (Flag(self.verdict, VERDICT_MOODS[self.verdict]), *([Flag(self.where)] if self.where else []))
        text = (self.answer or self.text, f"Next experiment: {self.suggestion}" if self.suggestion else "")
        return Card("Diagnosis", flags, text, (ladder_table(self.ladder),), self._next())

    def _next(self) -> tuple[tuple[str, str], ...]:
        after = [("found.best", "the better fit")] if self.after is not self.before else []
        if self.remainder is not None and self.remainder.proposed:
            after.append(("found.remainder.model + found.remainder.as_effect()", "with what remains as a curve"))
        return (*after, ("mi.plot_missing(found)", "see it"), ('mi.report(found, "report.html")', "all on one page"))

    def card(self) -> Card:
        """Return the answer, then what it rests on: place, parameters before and after, the effects tried."""
        first = self.summary()
        tables = [parameter_table(self.after, self.before)] if self.after is not self.before else []
        tables += [ranking_table(self.ranking, 6)] if self.ranking else []
        return replace(first, text=(*first.text, *self.details), tables=(*first.tables, *tables))

    def __str__(self) -> str:
        return str(self.summary())

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of ``diagnose --json``."""
        m, seen = self.missing, Rival.as_allowed if len(self.rivals) > 1 else Rival.of
        return {
            "verdict": self.verdict, "answer": self.answer, "text": self.text, "where": self.where,
            "location": {
                **_plain(m, "shares", "regions", "text"), "acts_like": m.acts_like or None,
                "depends_on": {k: [{"on": b.against, "explained": b.explained} for b in v] for k, v in m.bins.items()}},
            "ranking": [_plain(c, "effect", "predicted_drop", "refit_drop", "validation_nrmse", "held_out_gain",
                               "group", "parameters", "accepted", "reason") for c in self.ranking],
            "effects": list(self.effects),
            "ladder": [_plain(r, "added", "grade", "why", "gain", "gain_se", "nrmse", "validation_nrmse")
                       for r in self.ladder.rungs],
            "remaining": {"adequate": self.remaining.adequate, **_plain(self.remainder, "kind", "where", "follows"),
                          "text": self.remaining.text},
            "parameters_before": dict(self.before.values), "parameters_after": dict(self.after.values),
            "per_run": self.after.per_run, "groups": [list(g) for g in self.groups],
            "suggestion": self.suggestion, "stopped": self.stopped or None,
            "rivals": [seen(f).to_dict() for f in self.rivals], "best": Rival.of(self.best).to_dict()}


def _plain(result: object, *names: str) -> dict[str, Any]:
    """Return attributes as plain data, None where there is no result."""
    each = {n: getattr(result, n, None) for n in names}
    return {n: {k: None if v != v else v for k, v in a.items()} if isinstance(a, Mapping)  # NaN: nothing moves
            else list(a) if isinstance(a, tuple) else a for n, a in each.items()}


def share_table(what: str, shares: Mapping[str, float]) -> Table:
    """Return the share of the misfit of each balance or region."""
    return Table([what, "share of the squared error"], [[k, percent(v, 2)] for k, v in shares.items()])


def ranking_table(candidates: Sequence[Candidate], most: int = 10) -> Table:
    """Return the effects accepted, then others up to `most`, the best refitted among them; held-out errors if any."""
    nearest = max((c for c in candidates if c.refit_drop is not None), key=lambda c: c.refit_drop or 0.0, default=None)
    shown = sorted((c for k, c in enumerate(candidates) if k < most or c.accepted or c is nearest),
                   key=lambda c: not c.accepted)
    held_out = any(c.held_out_gain is not None for c in shown)
    header = ["effect", "predicted", "refitted", *(["held out"] if held_out else []), "verdict"]
    rows: list[list[Cell]] = []
    best = next((c.effect for c in candidates if c.accepted), "")
    group = {name for c in shown if c.accepted for name in c.group}
    for c in shown:
        gain = [percent(c.held_out_gain)] if held_out else []
        helps = c.reason.startswith("lowers the") and c.reason.endswith("%")
        instead = f"not distinguished from {best}" if c.effect in group else f"{c.reason}; {best} was taken instead"
        reason = instead if helps and best else c.reason.partition(" (gain ")[0]
        verdict = Flag("accepted", "good") if c.accepted else (reason or "not refitted")
        refit = None if c.refit_drop is None else round(c.refit_drop, 5)
        rows.append([c.effect, percent(round(c.predicted_drop, 5)), percent(refit), *gain, verdict])
    note = ("Fall of the squared error, predicted from sensitivities and refitted; held out (runs, or blocks left "
            "out): fall of the error, mean over channels and runs, lone wrong samples left aside.")
    return Table(header, rows, "Effects tried", note, left=(0, len(header) - 1))


def ladder_table(ladder: Ladder) -> Table:
    """Return the errors of the model on each rung, as fitted and held out."""
    first = ladder.rungs[0]
    channels = {c: channel_name(c, units_of(first.fit.problem.experiments).get(c, "")) for c in first.nrmse}
    held_out = any(r.validation_nrmse for r in ladder.rungs)
    header = ["model", *(f"{name}, fitted" for name in channels.values()),
              *(f"{name}, held out" for name in channels.values() if held_out)]
    rows = []
    for r in ladder.rungs:
        name = first.fit.model.title if r.added is None else f"+ {r.added}"
        name += "".join(f" − {gone}" for gone in r.removed)
        held = [percent((r.validation_nrmse or {}).get(c)) for c in channels] if held_out else []
        rows.append([name, *(percent(r.nrmse.get(c)) for c in channels), *held])
    return Table(header, rows, "NRMSE before and after" if len(rows) > 1 else "NRMSE", NRMSE)
