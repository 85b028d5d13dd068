"""The explorer of a model in a notebook: tick effects, move parameters, see curves and errors change, refit."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from html import escape
from typing import Any

import numpy as np

from motorid.diagnosis.score_test import rank
from motorid.display.cards import Card
from motorid.display.numbers import counted, duration
from motorid.effects import LIBRARY, get
from motorid.errors import MissingDependency, ModelError, MotoridError, UsageError
from motorid.estimation.fit import fit
from motorid.estimation.result import Fit, checked
from motorid.estimation.start_values import with_suited_effects
from motorid.model.definition import Effect, Parameter
from motorid.model.model import Model
from motorid.problem.problem import Problem
from motorid.problem.simulate import error_table, evaluate

TITLES = {"voltage": "Voltage balance", "torque": "Torque balance", "transmission": "Transmission", "sensor": "Sensors"}
REACH = 10.0  # a slider goes from a tenth to ten times the value it begins with


def explore(fit: Fit, *, effects: Iterable[Effect | str] | None = None) -> "Explorer":
    """Play with a fit in a notebook: tick effects, move parameters, see the curves and the error, refit.

    Effects stand by balance, the most promising first, with the share of the misfit that each is predicted to remove.

    Parameters
    ----------
    fit : Fit
    effects : iterable of Effect or str, optional
        What can be ticked; by default every effect of the library that the measured channels can see.

    Returns
    -------
    Explorer
        Shows itself at the end of a cell. ``explorer.fit`` is the last refit, ``explorer.model`` the model as ticked.

    Raises
    ------
    MissingDependency
        Without ipywidgets.

    Examples
    --------
    >>> play = mi.explore(fit, effects=["coulomb", "stribeck"])  # its widgets show in a notebook
    """
    checked(fit, "explore")
    try:
        import ipywidgets  # noqa: F401  whether it is installed
    except ImportError:
        raise MissingDependency("mi.explore needs ipywidgets: pip install 'motorid[notebooks]'.") from None
    chosen = LIBRARY.values() if effects is None else [get(e) if isinstance(e, str) else e for e in effects]
    own = [e for e in fit.model.effects if e.name not in {c.name for c in chosen}]
    return Explorer(fit, [e for e in (*own, *chosen) if effects is not None or _can_be_seen(fit, e)])


class Explorer:
    """What `explore` shows. Everything that the mouse can do is a method, too.

    `fit` is the one given, or the last refit; `model` is as ticked and set at present, `evaluation` its errors on the
    records; `message` says what the last action did, or why it could not; `widget` is the controls and the figure."""

    def __init__(self, start: Fit, effects: Sequence[Effect]) -> None:
        self.fit, self.runs, self._first = start, start.problem.experiments, start
        self.model, self.evaluation, self.message = start.model, evaluate(start, self.runs), ""
        self._gains = {s.effect.name: s.drop for s in rank(start, effects)}
        self._effects = {e.name: e for e in sorted(effects, key=lambda e: -self._gains.get(e.name, 1.0))}
        self._quiet, self._figure = False, None
        self._build()

    def tick(self, name: str, on: bool = True) -> None:
        """Put the effect `name` into the model, at a size that suits the records, or take it out."""
        with self._reasons_said(self._show_controls):
            if name not in self._effects:
                raise UsageError(f"there is no effect '{name}' here.")
            model = self.model + self._effects[name] if on else self.model.without(name)
            self._take(with_suited_effects(model, self.runs), f"{'with' if on else 'without'} {name}")

    def move(self, **values: float) -> None:
        """Set parameters, in SI units."""
        known = self.model.parameters
        with self._reasons_said(self._show_values):
            for name in values:
                if name not in known:
                    raise UsageError(f"the model has no parameter '{name}'; it has {', '.join(known)}.")
            self._take(self.model.start_at(values), "moved")

    def refit(self) -> None:
        """Fit the model with the ticked effects, from its present values."""
        p = self._first.problem
        with self._reasons_said(self._show_controls):
            self.fit = fit(self.model, self.runs, engine=p.engine, initial=p.initial, weights=p.weights, loss=p.loss)
            self._take(self.fit.model, f"refitted: {self.fit.status} in {duration(self.fit.seconds)}")

    def reset(self) -> None:
        """Go back to the fit that it began with."""
        self.fit = self._first
        with self._reasons_said(self._show_controls):
            self._take(self._first.model, "back to the first fit")

    @contextmanager
    def _reasons_said(self, show: Callable[[], None]) -> Iterator[None]:
        """Say why something cannot be done, and stay as it was; either way, `show` what is so now."""
        try:
            yield
        except MotoridError as error:
            self._say(str(error))
        show()

    def _take(self, model: Model, done: str) -> None:
        """Take `model` if it can be simulated."""
        problem = self._first.problem
        self.evaluation = evaluate(model, self.runs, engine=problem.engine, initial=problem.initial)
        self.model = model
        self._say(done)
        self._draw()

    def _build(self) -> None:
        import ipywidgets as w

        self._w: Any = w
        self._picture = w.Image(format="png", layout=w.Layout(max_width="100%"))
        self._errors, self._status = w.HTML(), w.HTML()
        self.boxes = {n: self._box(n) for n in self._effects}
        self._sliders = w.VBox()
        refit = w.Button(description="Refit", button_style="primary", tooltip="Fit the model with the ticked effects")
        reset = w.Button(description="Reset", tooltip="Back to the first fit")
        refit.on_click(lambda _: self.refit())
        reset.on_click(lambda _: self.reset())
        self.buttons = {"refit": refit, "reset": reset}
        moved = w.VBox([w.HTML("<b>Parameters</b>"), self._sliders, w.HBox([refit, reset]), self._status],
                       layout=w.Layout(width="25rem", flex="0 0 auto"))
        shown = w.VBox([self._picture, self._errors], layout=w.Layout(flex="1 1 30rem"))
        side = w.HBox([moved, shown], layout=w.Layout(flex_flow="row wrap", width="100%"))
        ticks = [w.HTML("Effects, with the share of the first fit's squared error that each is predicted to remove; "
                        "hover for the law.")]
        for balance, title in TITLES.items():
            boxes = [self.boxes[n] for n, e in self._effects.items() if e.balance == balance]
            grid = w.GridBox(boxes, layout=w.Layout(grid_template_columns="repeat(auto-fill, minmax(15rem, 1fr))"))
            ticks += [w.HTML(f"<b>{title}</b>"), grid] if boxes else []
        self.widget = w.VBox([side, *ticks], layout=w.Layout(width="100%"))
        self._draw()
        self._show_controls()

    def _box(self, name: str) -> Any:
        gain = self._gains.get(name, 0.0)
        label = f"{name} −{100 * gain:.0f} %" if gain >= 0.005 else name
        box = self._w.Checkbox(value=name in self.model.effect_names, description=label, indent=False,
                               tooltip=self._effects[name].doc, layout=self._w.Layout(width="auto"))
        box.observe(lambda change: self._quiet or self.tick(name, change["new"]), "value")
        return box

    def _slider(self, p: Parameter) -> Any:
        w = self._w
        size = abs(p.value) or 1e-3
        common: dict[str, Any] = {"description": p.name, "style": {"description_width": "4rem"},
                                  "layout": w.Layout(width="19rem"), "tooltip": p.doc}
        if p.positive:
            power = float(np.log10(p.value))
            slider = w.FloatLogSlider(value=p.value, base=10, min=power - 1, max=power + 1, step=0.002,
                                      readout_format=".3g" if 1e-3 <= p.value < 1e4 else ".2e", **common)
        else:
            low, high = max(p.lower, p.value - REACH * size), min(p.upper, p.value + REACH * size)
            step = 1.0 if p.order else (high - low) / 2000
            slider = w.FloatSlider(value=p.value, min=low, max=high, step=step, readout_format=".3g", **common)
        slider.observe(lambda change: self._dragged(slider, p.name, change["new"]), "value")
        return slider

    def _dragged(self, slider: Any, name: str, value: float) -> None:
        """Follow a slider, but not the half step by which a browser rounds what it is given to show."""
        now = self.model.parameters[name].value
        if not self._quiet and abs(_position(slider, value) - _position(slider, now)) > 0.5 * slider.step:
            self.move(**{name: value})

    def _show_controls(self) -> None:
        """Make ticks and sliders agree with the model."""
        self._quiet = True
        for name, box in self.boxes.items():
            box.value = name in self.model.effect_names
        wanted = [p for p in self.model.parameters.values() if p.name != "sgn_width"]
        self.sliders = {p.name: self._slider(p) for p in wanted}
        self._sliders.children = tuple(self._w.HBox([self.sliders[p.name], self._w.Label(p.unit)]) for p in wanted)
        self._quiet = False

    def _show_values(self) -> None:
        self._quiet = True
        for name, slider in self.sliders.items():
            value = self.model.parameters[name].value
            slider.max = max(slider.max, _position(slider, value))
            slider.min = min(slider.min, _position(slider, value))
            slider.value = value
        self._quiet = False

    def _draw(self) -> None:
        from motorid.plots.fits import LiveFit

        if self._figure is None:
            self._figure = LiveFit(self.evaluation, before=self._first)
        self._picture.value = self._figure.png(self.evaluation)
        table = error_table({"now": self.evaluation, "at first": self._first.evaluation})
        self._errors.value = Card(self.model.title, tables=(table,)).to_html()

    def _say(self, message: str) -> None:
        self.message = message
        self._status.value = f"<span>{escape(message)}</span>"

    def _repr_mimebundle_(self, **options: Any) -> Any:
        return self.widget._repr_mimebundle_(**options)

    def __repr__(self) -> str:
        return f"<explorer of {self.model.title} on {counted(len(self.runs), 'run')}>"


def _can_be_seen(fit: Fit, effect: Effect) -> bool:
    if effect.name in fit.model.effect_names:
        return True
    try:
        Problem(fit.model + effect, fit.problem.experiments)
    except ModelError as error:
        return "describe the same" in str(error) or "takes" in str(error)  # it may be ticked once the other is not
    return True


def _position(slider: Any, value: float) -> float:
    return float(np.log10(value)) if type(slider).__name__ == "FloatLogSlider" else value
