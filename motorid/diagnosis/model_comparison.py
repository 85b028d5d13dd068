"""Which of two models is to be preferred: by what they predict of data that they were not fitted to.

On a tie the smaller model wins, then the effect that is met more often."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, reduce

import numpy as np

from motorid.diagnosis.predictive_score import Evidence, HeldOut, Predictions, compare, finer
from motorid.diagnosis.thresholds import FINER, LARGER, MOST, PLAIN, SEARCHED, TRIFLE
from motorid.effects import LIBRARY
from motorid.estimation.fit import follows
from motorid.estimation.result import Fit
from motorid.model.model import Model
from motorid.problem.problem import Problem
from motorid.problem.simulate import moving

COMMON = ("coulomb", "gravity", "brush_drop", "winding_heating", "cogging", "load_friction", "quadratic_drag",
          "constant_load", "speed_lag", "driver_dead_band", "spring")  # what is met most, first


@dataclass(frozen=True, eq=False)
class Node:
    """One model in the search: its fit, and what it predicts of data that it was not fitted to.

    `objection` says why its last effect is not the thing itself, whatever it predicts: a wrong sign, a shape at its
    limit; empty if it may be. `reason` says what it gained on its parent."""

    fit: Fit
    added: str | None
    predictions: Predictions
    parent: "Node | None" = None
    objection: str = ""
    reason: str = ""

    @property
    def key(self) -> frozenset[str]:
        """Names of the effects."""
        return frozenset(self.fit.problem.model.effect_names)

    @property
    def size(self) -> int:
        """Number of free parameters."""
        return size_of(self.fit.problem.model, self.fit.problem)

    @property
    def search(self) -> float:
        """Nats that chance gains where each order of an angle effect is the best of many."""
        return sum(any(p.order for p in e.parameters) for e in self.fit.model.effects) * float(np.log(SEARCHED))


def size_of(model: Model, problem: Problem) -> int:
    """Return the number of free parameters on the records of `problem`, those of every run counted for each."""
    own = sum(p.vary and p.per_run for p in model.parameters.values())
    return len(model.free_names) + own * (len(set(problem.unknowns.firsts)) - 1)


def node_of(fit: Fit, held: HeldOut, added: str | None = None, parent: Node | None = None) -> Node:
    """Judge a fit; SimulationError if it cannot be simulated on the held-out runs."""
    return Node(fit, added, held.predictions(fit), parent)


_compared = lru_cache(maxsize=4096)(compare)


def evidence(old: Node, new: Node) -> Evidence:
    """Return what `new` predicts better than `old`, the search for orders paid for."""
    found = _compared(old.predictions, new.predictions)
    return replace(found, gain=found.gain - new.search + old.search)


def share_removed(was: Mapping[str, float], is_: Mapping[str, float]) -> float:
    """Return which share of the squared error is gone, by the NRMSE of channels: their geometric mean."""
    logs = [np.log(max(is_[c], 1e-300) / max(e, 1e-300)) for c, e in moving(was).items()]
    return 1 - float(np.exp(2 * np.mean(logs))) if logs else 0.0


def share_of(effect: str, last: Node, without: Node) -> float:
    """Return the share of the squared error that an effect removed where it came on the way to `last`."""
    node = last
    while node.parent is not None and effect in node.parent.key:
        node = node.parent
    both = (without, last) if node.parent is None else (node.parent, node)
    return share_removed(*({c: e.nrmse for c, e in n.predictions.held_out.items()} or n.fit.nrmse for n in both))


def beats(new: Node, old: Node) -> bool:
    """Tell whether `new` is to be preferred to `old`, which may be smaller."""
    return evidence(old, new).worth_it


def superfluous(node: Node, smaller: Node) -> bool:
    """Tell whether a smaller model does as well: what is surely better on the whole stays, whatever one swing does."""
    return not beats(node, smaller) and not evidence(smaller, node).sure


def preferred(new: Node, old: Node) -> bool:
    """Tell whether `new` is to be preferred to `old`: it predicts better, or it is the smaller on a tie."""
    return beats(new, old) or (new.size < old.size and superfluous(old, new))


def tied(a: Node, b: Node) -> bool:
    """Tell whether neither of two models is to be preferred."""
    return not beats(a, b) and not beats(b, a)


def choose(children: Sequence[Node], parent: Node) -> tuple[Node, list[Node]] | None:
    """Return the best child, the smaller on a tie, a law before sizes of every run, and all in order; None without any.

    Gains on the parent, in effective samples of a child's own residual, order them; which of two is better, both tell.
    """
    if not children:
        return None
    ordered = sorted(children, key=lambda n: -evidence(parent, n).gain)
    chosen = reduce(lambda best, n: n if beats(n, best) else best, ordered)
    for _ in ordered:  # ties are not transitive: what is tied with the smaller model may be smaller still
        near = [n for n in ordered if n is chosen or not beats(chosen, n) or _as_likely(n, chosen)]
        near = [n for n in near if _price(n) == min(map(_price, near))]
        least = min(1 - evidence(parent, n).fall for n in near)  # no equal leaves plainly more, however unsure that is
        near = [n for n in near if (1 - PLAIN) * (1 - evidence(parent, n).fall) <= least]
        added = {n.added for n in near if n.added in LIBRARY}
        wider = {name for name in added if name and added & {*LIBRARY[name].includes}}
        chosen = min(near, key=lambda n: (n.added in wider, rarity(n.added), -evidence(parent, n).gain))
    laws = _laws_as_good(chosen, children, parent)
    best = choose(laws, parent) if laws else None
    return best[0] if best else chosen, ordered


def _laws_as_good(chosen: Node, children: Sequence[Node], parent: Node) -> list[Node]:
    """Return the models with one law for all runs that remove all but a trifle of what sizes of every run's own do, and
    leave more than noise. Such a size describes a run, a held-out one too, and explains none."""
    if len(chosen.fit.per_run) == len(parent.fit.per_run) or not far(chosen.fit):
        return []
    most, *shares = (1 - (1 - evidence(parent, n).fall) ** 2 for n in (chosen, *children))  # of the squared error
    return [n for n, share in zip(children, shares, strict=True) if share > (1 - TRIFLE) * most
            and len(n.fit.per_run) == len(parent.fit.per_run) and not n.objection]


def _price(node: Node) -> tuple[bool, int]:
    """What decides between equals: no rare device in the place of dry friction, as all that turns rubs; then size."""
    return "eddy_brake" in node.key and not rubs(node), node.size


def rubs(node: Node) -> bool:
    """Tell whether a model has dry friction."""
    return any("coulomb" in (e.name, *e.includes) for e in node.fit.model.effects)


def _as_likely(node: Node, chosen: Node) -> bool:
    """Tell whether a model that rubs predicts hardly worse than one with a rare device that leaves more than noise:
    what is missing beside either may make the difference, where that is less than what is left."""
    rare = _price(chosen)[0] and rubs(node) and not node.objection
    return rare and bool(far(chosen.fit)) and follows(chosen.fit) and (1 - evidence(node, chosen).fall) ** 2 > MOST


def group_of(chosen: Node, siblings: Sequence[Node], includes: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """Names of the siblings that these data cannot distinguish from `chosen`, what contains it left out."""
    others = (n for n in siblings if n is not chosen and n.parent is chosen.parent and not n.objection)
    return tuple(dict.fromkeys(n.added for n in others if n.added not in (None, chosen.added)
                               and chosen.added not in includes.get(n.added, ()) and tied(n, chosen)))


def rarity(name: str | None) -> int:
    """Rank of an effect by how rarely it is met; decides between equals."""
    return COMMON.index(name) if name in COMMON else len(COMMON)


def far(fit: Fit) -> list[str]:
    """Return the channels whose errors are plainly larger than their noise, and than what can be asked of a model."""
    return [c for c in fit.problem.outputs if fit.misfit[c] > LARGER and not finer(fit, c)]


def at_noise(node: Node) -> bool:
    """Tell whether a model leaves hardly more than noise, and hardly more on the held-out runs than on the others."""
    least = {c: float(np.clip(m, 1.0, LARGER)) for c, m in node.fit.misfit.items()}
    return not far(node.fit) and all(e.misfit < LARGER * least.get(c, 1.0) or (finer(node.fit, c) and e.nrmse < FINER)
                                     for c, e in node.predictions.held_out.items())
