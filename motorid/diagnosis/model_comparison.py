"""Which of two models is to be preferred, and whether an addition is worth its parameters.

Every addition must lower the error on data it was not fitted to and be worth its parameters on effective samples
(BIC, Schwarz 1978); on a tie the smaller model wins, then the effect that is met more often.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from motorid.diagnosis.cross_validation import LEAST_FALL, HeldOut, train_errors
from motorid.diagnosis.residual_analysis import Errors, Gain, astray, compare_errors
from motorid.diagnosis.results import Candidate
from motorid.estimation.result import Fit

COMMON = (
    "coulomb",
    "gravity",
    "brush_drop",
    "winding_heating",
    "cogging",
    "load_friction",
    "quadratic_drag",
    "constant_load",
    "speed_lag",
    "driver_dead_band",
)  # what is met most, first
EVIDENCE = 4.0  # log likelihood ratio beyond the price of the parameters
TIE = 3.0  # log likelihood ratio below which two models count as equal
PLAIN = 0.1  # fall of the error that needs no statistics: what is left may be smooth for other reasons
INDIFFERENT = 0.03  # change of the held-out error that says nothing where the error on the records falls plainly
CLOSE = 0.01  # relative error below which two models count as equal


@dataclass(frozen=True, eq=False)
class Node:
    """One model in the search: its fit and its errors, on the records and held out."""

    fit: Fit
    added: str | None
    train: Errors
    held: Errors
    parent: Node | None = None
    candidate: Candidate | None = None
    children: tuple[Candidate, ...] = ()

    @property
    def key(self) -> frozenset[str]:
        """Names of the effects."""
        return frozenset(self.fit.problem.model.effect_names)

    @property
    def size(self) -> int:
        """Number of free parameters."""
        return len(self.fit.problem.model.free_names)


def node_of(fit: Fit, held: HeldOut, added: str | None = None, parent: Node | None = None) -> Node:
    """Judge a fit.

    Raises
    ------
    SimulationError
        If it cannot be simulated on the held-out runs.
    """
    return Node(fit, added, train_errors(fit), held.errors(fit), parent)


@dataclass(frozen=True, eq=False)
class Judge:
    """Compares models by their errors; `root` is the model to begin with."""

    root: Node
    data: HeldOut

    @property
    def noise(self) -> Mapping[str, float]:
        """Noise per channel."""
        return self.data.noise

    def held_gain(self, old: Node, new: Node) -> Gain:
        """Return what `new` gains over `old` on held-out data.

        Held-out runs in which an effect hardly shows (a steady run, for a lag) say nothing about it, nor do those on
        which both go astray (a pendulum that falls over the top, or not, by a hair); then blocks of the fitted runs
        are held out in turn.
        """
        gain = compare_errors(old.held, new.held, self.noise)
        here = compare_errors(old.train, new.train, self.noise)
        telling = abs(gain.fall) > INDIFFERENT and not astray(old.held.nrmse(), new.held.nrmse())
        if self.data.validation is None or telling or here.fall < PLAIN:
            return gain
        return compare_errors(self.data.block_errors(old.fit), self.data.block_errors(new.fit), self.noise)

    def choose(self, children: Sequence[Node]) -> tuple[Node, list[Node]] | None:
        """Return the best child, the smaller on a tie, and the children in order; None without any."""
        if not children:
            return None
        ordered = sorted(children, key=lambda n: -self.worth(n))
        chosen = ordered[0]
        while True:  # ties are not transitive: what is tied with the smaller model may be smaller still
            tied = [n for n in ordered if n is chosen or self.tied(chosen, n)]
            smaller = min(tied, key=lambda n: (n.size, rarity(n.added), -self.worth(n)))
            if smaller is chosen or (smaller.size, rarity(smaller.added)) >= (chosen.size, rarity(chosen.added)):
                break
            chosen = smaller
        return chosen, ordered

    def worth(self, node: Node) -> float:
        """Return how much smaller the errors are than those of the first model, held-out errors first."""
        held = compare_errors(self.root.held, node.held, self.noise)
        train = compare_errors(self.root.train, node.train, self.noise)
        return -float(np.log(max(1 - held.fall, 1e-12)) + 0.5 * np.log(max(1 - train.fall, 1e-12)))

    def tied(self, best: Node, other: Node) -> bool:
        """Tell whether `best` is better than `other` by no more than chance or a trifle."""
        held = compare_errors(other.held, best.held, self.noise)
        train = compare_errors(other.train, best.train, self.noise)
        return (held.log_ratio < TIE or held.fall < CLOSE) and (train.log_ratio < TIE or train.fall < CLOSE)

    def beats(self, new: Node, old: Node) -> bool:
        """Tell whether `new` is worth its extra parameters over `old`."""
        gain = compare_errors(old.train, new.train, self.noise)
        held = self.held_gain(old, new)
        return worth_it(new.size - old.size, gain) and not held_out_objection(held)

    def superfluous(self, node: Node, smaller: Node) -> bool:
        """Tell whether `smaller`, contained in `node`, does as well: on the records, or plainly better held out."""
        lost = compare_errors(smaller.train, node.train, self.noise).fall
        won = compare_errors(node.held, smaller.held, self.noise).fall
        return not self.beats(node, smaller) and (lost < PLAIN or won > PLAIN)

    def group(self, chosen: Node, siblings: Sequence[Node], includes: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
        """Names of the siblings that these data cannot tell from `chosen`."""
        return tuple(
            n.added
            for n in siblings
            if n is not chosen
            and n.added not in (None, chosen.added)
            and n.parent is chosen.parent
            and chosen.added not in includes.get(n.added, ())
            and self.tied(n, chosen)
            and self.tied(chosen, n)
        )


def worth_it(extra: int, gain: Gain) -> bool:
    """Tell whether a gain pays for `extra` parameters: by its evidence, or by a fall of the error that anyone sees."""
    price = EVIDENCE + 0.5 * max(extra, 0) * float(np.log(max(gain.effective, 2.0)))
    return gain.log_ratio > price or gain.fall > PLAIN


def rarity(name: str | None) -> int:
    """Rank of an effect by how rarely it is met; decides between equals."""
    return COMMON.index(name) if name in COMMON else len(COMMON)


def held_out_objection(gain: Gain) -> str:
    """Say why the held-out error speaks against a model; empty if it does not."""
    if gain.fall < LEAST_FALL:
        return f"the held-out error does not fall ({100 * gain.fall:+.1f} %)"
    if gain.log_ratio < TIE and gain.fall < PLAIN:
        return "the held-out error falls by no more than chance would give"
    if gain.worst < -0.05 - 0.5 * gain.fall:
        return f"one channel's held-out error grows by {-100 * gain.worst:.0f} %"
    return ""
