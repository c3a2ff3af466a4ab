"""The search for an emulator's parameters: least squares on the logarithms of the parameters, from several starts.

Numbers of the recording (:mod:`~blinkgl.recordings.statistics`) are compared with those of a simulation, each
difference divided by its standard deviation by chance, with a robust loss (the method of simulated moments, McFadden,
Econometrica 57, 1989). Parameters that the data do not determine are left at their defaults, and named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import qmc

from blinkgl.config.events import EmulatorConfig
from blinkgl.errors import EventDataError
from blinkgl.recordings.clip import Clip
from blinkgl.recordings.simulation import emulator_config
from blinkgl.recordings.statistics import GroupSums, Targets, sums, target
from blinkgl.types.trees import Tree

TRIED = 64
"""Number of random settings over the whole range of the parameters; the best are the starts."""
STEP = 0.05
"""Step of a parameter's logarithm, for derivatives: far above the jumps by single events."""
UNDETERMINED = 0.5
"""Standard deviation of a parameter's logarithm above which the data do not determine it."""
VAGUE = 0.25
"""Standard deviation above which other values are tried, too."""
LEAST_CHANCE = 0.05
"""Smallest part of chance in a number's error, where chance is known."""
TOLERANCE = 0.5
"""Largest loss of fit by resetting an undetermined parameter to its default."""
PRIOR = 2.0
"""Weight of a deviation by one standard deviation from typical cameras: as the smaller of the blocks of numbers."""
_MOST_STEPS = 20
_FEW_STEPS, _PLACES = 3, 6
_WORTH = 0.2
"""How much worse than the best a point may be, with derivatives from elsewhere, to be worth a descent."""
_EACH = 3
"""Points per start, from which a few steps are tried."""
_LITTLE = 0.01
"""Fraction of the cost that a step must gain; otherwise the descent ends."""


class Search:
    """Searches for the parameters, in their logarithms."""

    def __init__(
        self,
        parts: Sequence[tuple[Clip, int]],
        base: EmulatorConfig,
        seed: int,
        progress: Callable[[float], None] = lambda _: None,
    ):
        """Prepare a search. parts : clips of one camera, and the number of intervals used of each: one set of
        parameters for all. ``keys`` are the parameters of the search, ``place`` their logarithms so far."""
        self._parts, self._base, self._seed, self._progress = parts, base, seed, progress
        # What a model has no parameter for it would buy with those that are for something else.
        one = lambda clip, stop: target(sums(clip.events, clip, 0, stop), together=base.one_threshold)
        self.target = Targets([one(*part) for part in parts])
        if not len(self.target.values):
            raise EventDataError(
                "too few pixels to estimate an emulator's parameters",
                value=sum(int(clip.used.sum()) for clip, _ in parts),
            )
        self.evaluations = 0
        self.undetermined: dict[str, str] = {}
        self.cost = float("nan")
        self._set: Tree = {}
        self.keys: list[str] = []
        self.place: np.ndarray = np.empty(0)
        self._jacobian: np.ndarray = np.empty((0, 0))
        self._residual: np.ndarray = np.empty(0)
        self._planned = 1

    def responding(self, keys: list[str]) -> list[str]:
        """Return the parameters that affect the scene; the others are named and not changed. The test uses the middle
        of all ranges, with one key at either end."""
        middle = self._ends(keys).mean(axis=1)
        here, responding = self._off(keys, middle), []
        for i, ends in enumerate(self._ends(keys)):
            places = np.repeat(middle[None], 2, axis=0)
            places[:, i] = ends
            if any(np.abs(self._off(keys, at) - here).max() > 0 for at in places):
                responding.append(keys[i])
            else:
                self.undetermined[keys[i]] = "makes no difference to this scene, left as it was"
                self._set[keys[i]] = self._default(keys[i])
        return responding

    def roughly(self, keys: list[str], starts: int) -> np.ndarray:
        """Return the logarithms of the parameters at the end of the best of several descents: a few steps from more
        points, then all steps from those that led lowest."""
        ends = self._ends(keys)
        # Sobol points cover the range more evenly than random ones; the defaults are tried before them.
        tried = qmc.scale(qmc.Sobol(len(keys), seed=self._seed).random(TRIED), *ends.T)
        tried = np.vstack([np.clip(self._defaults(keys), ends[:, 0], ends[:, 1]), tried])
        # How many evaluations there may be, for the progress only.
        self._planned = len(tried) + starts * 20 * (len(keys) + 2)
        ordered = tried[np.argsort([_loss(self._difference(keys, at)) for at in tried])]
        self.target.beside(self._sums(keys, ordered[0]), floor="expected")
        first = [self._descend(keys, one, steps=_FEW_STEPS) for one in _apart(ordered, _EACH * starts)]
        first.sort(key=lambda found: found[0])
        self.keys = keys
        self.place = min((self._descend(keys, at) for _, at in first[:starts]), key=lambda found: found[0])[1]
        return self.place

    def run(self, keys: list[str], start: np.ndarray) -> None:
        """Run the search. start : logarithms of the parameters, where :meth:`roughly` ended."""
        if not keys:
            self.cost = _loss(self._difference([], np.empty(0)))
            return
        self.target.beside(self._sums(keys, start), floor="expected")
        best = self._descend(keys, start)
        # First as if the model were exact, with only chance errors; then with the errors that the model turns
        # out to have.
        for floor in ("lowest", "seen"):
            self.target.beside(self._sums(keys, best[1]), floor=floor)
            best = self._descend(keys, best[1])
            if floor == "lowest":
                best = self._scanned(keys, best)
        while True:
            self.cost, self.place, self.keys = best[0], best[1], keys
            self._residual = self._difference(keys, best[1])
            self._jacobian = self._derivatives(keys, best[1], self._residual)
            spread = self._spread()
            worst = int(np.argmax(spread))
            if spread[worst] <= UNDETERMINED:
                return
            key = keys[worst]
            keys = [k for k in keys if k != key]
            default = float(np.clip(np.exp(self._defaults([key])[0]), *self._base.fitted[key].ends))
            there = float(np.exp(best[1][worst]))
            others = np.delete(best[1], worst)
            within = f"the data tell it within a factor of {min(np.exp(spread[worst]), 1e6):.2g} at best"
            self._set[key] = self._default(key)
            again = (_loss(self._difference(keys, others)), others)  # often the others need not follow
            if again[0] > best[0] + TOLERANCE:
                again = self._descend(keys, others)
            if again[0] <= best[0] + TOLERANCE:
                self.undetermined[key] = f"not told by the recording, left at its default ({within})"
                best = again
            else:
                self._set[key] = there
                side = "less" if there < default else "more"
                self.undetermined[key] = f"told only to be {side} than its default ({within})"
                best = self._descend(keys, others)
            if not keys:
                self.cost, self.place = best
                self.keys = []
                return

    def config(self, keys: list[str] | None = None, at: np.ndarray | None = None) -> EmulatorConfig:
        keys, at = (self.keys, self.place) if keys is None or at is None else (keys, at)
        values = {key: float(np.exp(v)) for key, v in zip(keys, at)}
        base = self._base.model_dump()
        if base.get("threshold_ratio") is not None:  # of two thresholds that now go their own ways
            base["threshold_ratio"] = None
        return emulator_config({**base, **self._set, **values})

    def values(self) -> dict[str, float]:
        return {key: float(np.exp(v)) for key, v in zip(self.keys, self.place)}

    def uncertainty(self) -> dict[str, float]:
        """Return the uncertainty by chance of the recording and the simulation, larger where the model does not fit:
        from the change of the fit when a group of pixels is left out."""
        if not self.keys:
            return {}
        t = self.target
        weights = self._robust()
        count = len(t.values)
        # The rows after the first `count` belong to the prior, which does not depend on the recording.
        j = (self._jacobian * weights[:, None])[:count]
        # pull: the change of the parameters for a change of each number, as a Gauss-Newton step gives it.
        pull = np.linalg.solve(j.T @ j + self._prior(), j.T * weights[:count])
        moved = (t.jackknife - t.jackknife.mean(axis=0)) * (t.weight / t.error) @ pull.T
        groups = len(t.jackknife)
        spread = np.sqrt((groups - 1) / groups * (moved**2).sum(axis=0))
        # Where the model's error exceeds chance, that error; a number that hardly any group of pixels changes gives no
        # estimate of chance.
        known = t.chance > LEAST_CHANCE * t.error
        off = self._residual[:count][known] / t.weight[known] * t.error[known] / t.chance[known]
        misfit = max(1.0, float(np.sqrt(np.mean(off**2)))) if known.any() else 1.0
        # d(exp v) = exp(v) dv: from the logarithms to the parameters' own units.
        return {key: float(np.exp(v) * s * misfit) for key, v, s in zip(self.keys, self.place, spread)}

    def _spread(self) -> np.ndarray:
        slopes = (self._jacobian * self._robust()[:, None])[: len(self.target.values)]
        return np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes + self._prior())))

    def _robust(self) -> np.ndarray:
        """Return square roots of the loss's weights of the residuals."""
        # The loss 2 (sqrt(1 + r^2) - 1) has the derivative (1 + r^2)^-1/2 by r^2.
        return (1 + self._residual**2) ** -0.25

    def _prior(self) -> np.ndarray:
        """Return the information on the logarithms from typical cameras; where only the ends of a range are known, a
        normal law of the same width."""
        ends = self._ends(self.keys)
        # The variance of a uniform law is a twelfth of the square of its width.
        wide = 12 / np.diff(ends, axis=1)[:, 0] ** 2
        _, scale = self._usual(self.keys)
        return np.diag(np.where(scale > 0, scale**2, wide))

    def _usual(self, keys: list[str]) -> tuple[np.ndarray, np.ndarray]:
        """Return logarithms of typical values, and the weight of a deviation from them; 0 where nothing is known. An
        initial sensor defines what is typical."""
        usual, scale = np.zeros(len(keys)), np.zeros(len(keys))
        for i, key in enumerate(keys):
            known, default = self._base.fitted[key], self._default(key)
            if known.usual is None:
                continue
            stated = key in self._base.model_fields_set and default
            usual[i] = np.log(default if stated else known.usual)
            scale[i] = PRIOR / np.log(known.factor)
        return usual, scale

    def _default(self, key: str) -> float | None:
        return getattr(self._base, key)

    def _defaults(self, keys: list[str]) -> np.ndarray:
        other = {"contrast_threshold_off": "contrast_threshold"}
        values = [self._default(key) or (self._default(other[key]) if key in other else 0) or 0 for key in keys]
        return np.log([max(v, self._base.fitted[key].low) for key, v in zip(keys, values)])

    def _ends(self, keys: list[str]) -> np.ndarray:
        return np.log([self._base.fitted[key].ends for key in keys]).reshape(-1, 2)

    def _sums(self, keys: list[str], at: np.ndarray) -> list[GroupSums]:
        self.evaluations += 1
        self._progress(min(self.evaluations / self._planned, 0.99))
        config = self.config(keys, at)
        return [
            sums(clip.simulate(config, self._seed, stop=stop), clip, 0, stop, recorded)
            for (clip, stop), recorded in zip(self._parts, self.target.sums)
        ]

    def _difference(self, keys: list[str], at: np.ndarray) -> np.ndarray:
        """Return the simulation's errors, followed by the parameters' deviations from typical values."""
        usual, scale = self._usual(keys)
        return np.concatenate([self._off(keys, at), scale * (at - usual)])

    def _off(self, keys: list[str], at: np.ndarray) -> np.ndarray:
        return self.target.residual(self._sums(keys, at))

    def _derivatives(self, keys: list[str], at: np.ndarray, here: np.ndarray) -> np.ndarray:
        """Return derivatives by steps of ``STEP``, or wider ones where that has hardly any effect."""
        columns = []
        for i, (low, high) in enumerate(self._ends(keys)):
            # The wider step is taken only where the first one moves the residuals by less than 1 in all.
            for width in (STEP, 8 * STEP):
                # Backwards where a step forwards would leave the range.
                step = width if at[i] + width <= high else -width
                there = at.copy()
                there[i] = min(max(at[i] + step, low), high)
                moved = self._difference(keys, there) - here
                if moved @ moved > 1:
                    break
            columns.append(moved / step)
        return np.array(columns).T.reshape(len(here), len(keys))

    def _scanned(self, keys: list[str], best: tuple[float, np.ndarray]) -> tuple[float, np.ndarray]:
        """Search where a descent has no gradient: far from where a parameter matters (a dead time shorter than any
        interval, an offset darker than any pixel). Each weakly determined parameter is held at values over its whole
        range while the others follow; the descent restarts from a better point."""
        self.keys, self.place, self._residual = keys, best[1], self._difference(keys, best[1])
        self._jacobian = self._derivatives(keys, best[1], self._residual)
        vague = [i for i, spread in enumerate(self._spread()) if spread > VAGUE]
        start, numbers = best, len(self.target.values)
        for i in vague:
            others, held = [key for key in keys if key != keys[i]], self._set
            (low, high), tried = self._ends([keys[i]])[0], []
            # Without the held parameter's column and the row of its prior, which comes after those of the numbers.
            slopes = np.delete(np.delete(self._jacobian, i, axis=1), numbers + i, axis=0)
            for place in np.linspace(low, high, _PLACES + 2)[1:-1]:
                self._set = {**held, keys[i]: float(np.exp(place))}
                # With the derivatives of the scan's start: accurate enough to see which points are worth a descent.
                cost, at = self._descend(others, np.delete(start[1], i), slopes, _FEW_STEPS)
                tried.append((cost, np.insert(at, i, place)))
            self._set = held
            tried.sort(key=lambda one: one[0])
            # A point may be better although the nearest tried one is not, so its parameter is released.
            worth = [at for cost, at in tried[:2] if cost < best[0] + max(_WORTH * best[0], 2.0)]
            best = min([best, *(self._descend(keys, at) for at in worth)], key=lambda one: one[0])
        return best

    def _descend(
        self, keys: list[str], start: np.ndarray, slopes: np.ndarray | None = None, steps: int = _MOST_STEPS
    ) -> tuple[float, np.ndarray]:
        """Return (loss, logarithms of the parameters) at the end of least squares from ``start``.

        slopes : fixed derivatives; None: those of each point."""
        if not keys:
            return _loss(self._difference(keys, start)), start
        low, high = self._ends(keys).T
        solution = least_squares(
            lambda at: self._difference(keys, at),
            np.clip(start, low, high),
            jac=lambda at: self._derivatives(keys, at, self._difference(keys, at)) if slopes is None else slopes,
            bounds=(low, high),
            loss="soft_l1",
            ftol=_LITTLE,
            max_nfev=steps,
        )
        # scipy's cost is half of the loss.
        return 2 * float(solution.cost), solution.x


def _loss(residual: np.ndarray) -> float:
    return float(np.sum(2 * (np.sqrt(1 + residual**2) - 1)))


def _apart(ordered: np.ndarray, count: int) -> list[np.ndarray]:
    """Return the best ones, no two of them within a factor of two in all parameters."""
    chosen: list[np.ndarray] = []
    for place in ordered:
        if all(np.abs(place - other).max() > np.log(2) for other in chosen):
            chosen.append(place)
        if len(chosen) == count:
            break
    return chosen
