"""Pictures of a Monte Carlo study: errors beside the stated density, coverage, pairs, confusion, and envelopes."""

from collections.abc import Iterator

import numpy as np
import scipy.stats

from estimators.plots.style import MARKERS, MODELS, SMALL, Picture, picture, tidy, title
from estimators.study.results import StudyResults

_MOST_PARAMETERS = 9
_MOST_PAIRS = 4
_NOMINAL = 0.95


def plot_estimates(found: StudyResults) -> Picture:
    """Draw the histogram of every estimate's error, and the normal density with the mean error and the stated standard deviation.

    Raises:
        ValueError: nothing was estimated.
    """
    names = _shown(found)
    rows = [(e, n) for e, n in enumerate(found.estimators) if any(_errors(found, e, p) is not None for p, _ in names)]
    figure = picture(1.2 + 1.9 * len(names), 0.8 + 1.7 * len(rows))
    panels = figure.subplots(len(rows), len(names), squeeze=False)
    for at, (panel_row, (e, estimator)) in enumerate(zip(panels, rows, strict=True)):
        for axes, (p, name) in zip(panel_row, names, strict=True):
            tidy(axes)
            axes.set_yticks([])
            axes.spines["left"].set_visible(False)
            error = _errors(found, e, p)
            if error is None:
                axes.set_axis_off()
                continue
            # An estimate that failed wildly must not make the others one bar.
            low, high = np.quantile(error, [0.01, 0.99]) if len(error) >= 100 else (error.min(), error.max())
            edges = np.linspace(low, high if high > low else low + 1e-12, 2 + min(30, int(np.sqrt(len(error)))))
            axes.hist(error, bins=edges.tolist(), density=True, color="0.8", edgecolor="white", linewidth=0.4)
            stated = _stated(found, e, p)
            if stated is not None and stated > 0:
                reach = 3.5 * max(stated, float(np.std(error)))
                grid = np.linspace(np.mean(error) - reach, np.mean(error) + reach, 300)
                axes.plot(grid, scipy.stats.norm.pdf(grid, np.mean(error), stated), **MODELS[1])
            axes.axvline(0.0, color=MODELS[0]["color"], linewidth=1.0, linestyle="--")
            if at == 0:
                axes.set_title(_broken(name), fontsize=SMALL)
            if at == len(rows) - 1:
                axes.set_xlabel("Error [% of truth]", fontsize=SMALL)
        panel_row[0].text(
            -0.08,
            0.5,
            _broken(estimator),
            transform=panel_row[0].transAxes,
            rotation=90,
            ha="right",
            va="center",
            fontsize=SMALL,
        )
    title(figure, _estimates_say(found))
    figure.supxlabel("Grey: found. Blue: stated by the estimator. Dashed: the truth.", fontsize=SMALL)
    return figure


def plot_coverage(found: StudyResults) -> Picture:
    """Return how often the stated 95 % interval holds the truth, by parameter and estimator, with its own confidence interval."""
    names = _shown(found)
    summary = found.summary()
    figure = picture(8.6, 1.6 + 0.42 * len(names))
    axes = figure.subplots()
    count = len(found.estimators)
    for e, estimator in enumerate(found.estimators):
        shown = [(y, p) for y, (p, _) in enumerate(names) if np.isfinite(summary["coverage"].values[e, p])]
        if not shown:
            continue
        places = np.array([y for y, _ in shown]) + 0.6 * ((e + 0.5) / count - 0.5)
        middle, low, high = (
            100 * np.array([summary[n].values[e, p] for _, p in shown])
            for n in ("coverage", "coverage_low", "coverage_high")
        )
        style = MODELS[e % len(MODELS)]
        axes.errorbar(
            middle, places, xerr=np.stack([middle - low, high - middle]), fmt=MARKERS[e % len(MARKERS)], color=style["color"],
            markersize=4, linewidth=1, capsize=2, label=estimator,
        )  # fmt: skip
    axes.axvline(100 * _NOMINAL, color="black", linewidth=0.8, linestyle="--")
    axes.set_yticks(range(len(names)), [name for _, name in names], fontsize=SMALL)
    axes.set_ylim(len(names) - 0.5, -0.5)
    least = np.nanmin(summary["coverage_low"].values[:, [p for p, _ in names]], initial=0.9)
    axes.set_xlim(100 * least - 5, 101)
    axes.set_xlabel("Intervals that hold the truth [%], dashed: 95 %", fontsize=SMALL)
    tidy(axes)
    axes.legend(fontsize=SMALL, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    title(figure, _coverage_says(found))
    return figure


def plot_pairs(found: StudyResults, estimator: str | None = None) -> Picture:
    """Draw errors of two parameters of one repetition against each other, for the first parameters.

    Args:
        found: of a study that estimates parameters.
        estimator: by default the last that estimates parameters.
    """
    names = _shown(found)[:_MOST_PAIRS]
    able = [n for e, n in enumerate(found.estimators) if any(_errors(found, e, p) is not None for p, _ in names)]
    chosen = estimator or able[-1]
    e = found.estimators.index(chosen)
    names = [(p, name) for p, name in names if _errors(found, e, p) is not None]
    count = len(names)
    figure = picture(2.0 + 1.9 * count, 1.4 + 1.7 * count)
    panels = figure.subplots(count, count, squeeze=False)
    for row, (below, name) in enumerate(names):
        for column, (beside, other) in enumerate(names):
            axes = panels[row][column]
            x, y = _errors(found, e, beside, all_rows=True), _errors(found, e, below, all_rows=True)
            if column > row or x is None or y is None:
                axes.set_axis_off()
                continue
            tidy(axes)
            if row == column:
                known = np.sort(x[np.isfinite(x)])
                axes.plot(known, np.linspace(0, 1, len(known)), **MODELS[1])
                axes.set_ylabel("Fraction below [1]", fontsize=SMALL)
            else:
                axes.plot(x, y, "o", color=MODELS[1]["color"], markersize=2.5, alpha=0.6)
                if column == 0:
                    axes.set_ylabel(f"{_broken(name)} [%]", fontsize=SMALL)
            if row == count - 1:
                axes.set_xlabel(f"{_broken(other)} [%]", fontsize=SMALL)
    title(figure, _pairs_say(found, e, names))
    return figure


def plot_confusions(found: StudyResults) -> Picture:
    """Draw the fraction of repetitions in which an effect was named, by what was hidden, as a heat map.

    Raises:
        ValueError: the study made no diagnosis.
    """
    hidden, named, fraction = found.confusion()
    figure = picture(max(5.6, 2.6 + 0.34 * len(named)), 2.2 + 0.3 * len(hidden))
    axes = figure.subplots()
    image = axes.imshow(100 * fraction, cmap="Greys", vmin=0.0, vmax=100.0, aspect="auto")
    axes.set_xticks(range(len(named)), list(named), rotation=45, ha="right", rotation_mode="anchor", fontsize=SMALL)
    axes.set_yticks(range(len(hidden)), list(hidden), fontsize=SMALL)
    axes.set_xlabel("Named, or the verdict", fontsize=SMALL)
    axes.set_ylabel("Hidden", fontsize=SMALL)
    for row, column in np.argwhere(fraction > 0):
        color = "white" if fraction[row, column] > 0.6 else "black"
        axes.text(column, row, f"{100 * fraction[row, column]:.0f}", ha="center", va="center", fontsize=7, color=color)
    axes.tick_params(length=0)
    bar = figure.colorbar(image, ax=axes, shrink=0.8)
    bar.set_label("Repetitions [%]", fontsize=SMALL)
    bar.ax.tick_params(labelsize=SMALL)
    title(figure, _confusion_says(found))
    return figure


def plot_envelopes(found: StudyResults) -> Picture:
    """Return the fraction of new conditions inside each envelope against the probability that it states.

    Raises:
        ValueError: the study made no envelopes.
    """
    said = found.envelope_coverage()
    said_of = next(e.name for e in found.spec.estimate if e.method == "envelope")
    figure = picture(6.4, 5.0)
    axes = figure.subplots()
    random = np.random.default_rng(0)  # stated probabilities are often one number: points are set beside each other
    for n, estimate in enumerate(e for e in found.spec.estimate if e.method == "envelope"):
        column = found["quantities"].sel(estimator=estimate.name)
        stated, inside = column.sel(quantity="stated").values, column.sel(quantity="inside").values
        beside = 100 * stated + random.uniform(-0.6, 0.6, len(stated))
        axes.plot(
            beside, 100 * inside, MARKERS[n % len(MARKERS)], color=MODELS[(n + 1) % len(MODELS)]["color"], markersize=4,
            alpha=0.7, label=estimate.name,
        )  # fmt: skip
    axes.plot([0, 100], [0, 100], color="black", linewidth=0.8, linestyle="--")
    axes.set_xlim(-2, 100)
    axes.set_ylim(-2, 102)
    axes.set_xlabel("Stated: least probability of a new condition inside [%]", fontsize=SMALL)
    axes.set_ylabel("New conditions inside [%]", fontsize=SMALL)
    tidy(axes)
    axes.legend(fontsize=SMALL, loc="lower right")
    title(
        figure,
        f"{said_of}: {100 * said['kept']:.0f} % of the envelopes hold at least what they state; "
        f"{100 * said['confidence']:.0f} % is promised",
    )
    return figure


def _shown(found: StudyResults) -> list[tuple[int, str]]:
    """Places and names of the parameters that are drawn; ratios only where there is nothing else."""
    names = found.layout.coordinates["parameter"]
    known = np.any(np.isfinite(found.arrays["estimate"]) & np.isfinite(found.arrays["truth"][:, None, :]), axis=(0, 1))
    places = [(p, name) for p, name in enumerate(names) if known[p]]
    plain = [(p, name) for p, name in places if "/" not in name]
    if not places:
        raise ValueError("nothing was estimated, so there is nothing to draw.")
    return (plain or places)[:_MOST_PARAMETERS]


def _scaled(found: StudyResults, e: int, p: int) -> tuple[np.ndarray, float]:
    """Return the errors of all repetitions, and what makes them percent of the truth."""
    truth = found.arrays["truth"][:, p]
    size = float(np.nanmean(np.abs(truth))) or 1.0
    return found.arrays["estimate"][:, e, p] - truth, 100 / size


def _errors(found: StudyResults, e: int, p: int, *, all_rows: bool = False) -> np.ndarray | None:
    error, factor = _scaled(found, e, p)
    known = np.isfinite(error)
    if not known.any():
        return None
    return factor * (error if all_rows else error[known])


def _stated(found: StudyResults, e: int, p: int) -> float | None:
    """Root mean square of the stated standard deviations, in percent of the truth."""
    if "std" not in found.arrays:
        return None
    std, (_, factor) = found.arrays["std"][:, e, p], _scaled(found, e, p)
    known = np.isfinite(std)
    return factor * float(np.sqrt(np.mean(std[known] ** 2))) if known.any() else None


def _each(found: StudyResults, name: str) -> Iterator[tuple[float, str, str]]:
    values = found.summary()[name].values
    for e, estimator in enumerate(found.estimators):
        for p, parameter in _shown(found):
            if np.isfinite(values[e, p]):
                yield float(values[e, p]), estimator, parameter


def _estimates_say(found: StudyResults) -> str:
    s = found.summary()
    worst: tuple[float, str] = (0.0, "")
    for e, estimator in enumerate(found.estimators):
        for p, parameter in _shown(found):
            bias, error = s["bias"].values[e, p], s["bias_std"].values[e, p]
            size = abs(s["truth"].values[e, p]) or 1.0
            if np.isfinite(error) and abs(bias) > 3 * error and abs(bias) / size > worst[0]:
                worst = (
                    abs(bias) / size,
                    f"{estimator} is biased most: {parameter} by {100 * bias / size:+.2g} % of its value",
                )
    return worst[1] or f"No estimate is biased beyond what {len(found.index)} repetitions can show"


def _coverage_says(found: StudyResults) -> str:
    """Say which intervals cover too little or too much, at a chance of 5 % for all of them together (Bonferroni)."""
    s = found.summary()
    several = [(estimator, parameter) for _, estimator, parameter in _each(found, "coverage")]
    if not several:
        return "No estimator states an interval"
    words: dict[str, dict[str, int]] = {"too short by": {}, "too long by": {}}
    for estimator, parameter in several:
        e, p = found.estimators.index(estimator), found.layout.coordinates["parameter"].index(parameter)
        covered, trials = s["coverage"].values[e, p], round(s["judged"].values[e, p])
        chance = scipy.stats.binomtest(round(covered * trials), trials, _NOMINAL).pvalue if trials else 1.0
        if chance < (1 - _NOMINAL) / len(several):
            how = words["too short by" if covered < _NOMINAL else "too long by"]
            how[estimator] = how.get(estimator, 0) + 1
    total = {name: sum(one == name for one, _ in several) for name in found.estimators}
    bad = [
        f"{how} {', '.join(f'{name} for {count} of {total[name]} parameters' for name, count in counts.items())}"
        for how, counts in words.items()
        if counts
    ]
    if not bad:
        return "Every stated interval covers as it says, as far as these repetitions show"
    return f"Intervals do not cover as they say: {'; '.join(bad)}"


def _pairs_say(found: StudyResults, e: int, names: list[tuple[int, str]]) -> str:
    best: tuple[float, str] = (0.0, "")
    for row, (below, name) in enumerate(names):
        for beside, other in names[:row]:
            x, y = _errors(found, e, beside, all_rows=True), _errors(found, e, below, all_rows=True)
            if x is None or y is None:
                continue
            known = np.isfinite(x) & np.isfinite(y)
            if known.sum() < 3 or np.ptp(x[known]) == 0 or np.ptp(y[known]) == 0:
                continue
            r = float(np.corrcoef(x[known], y[known])[0, 1])
            if abs(r) > abs(best[0]):
                best = r, f"With {found.estimators[e]}, {name} and {other} err together most (correlation {r:.2f})"
    return best[1] or f"Errors of {found.estimators[e]}"


def _confusion_says(found: StudyResults) -> str:
    hidden, named, fraction = found.confusion()
    totals = {h: int(np.sum(found.arrays["hidden"] == h)) for h in hidden}
    effects = [h for h in hidden if h != "nothing"]
    hits = sum(fraction[hidden.index(h), named.index(h)] * totals[h] for h in effects if h in named)
    count = sum(totals[h] for h in effects)
    said = f"The hidden effect is named in {hits:.0f} of {count} repetitions" if count else ""
    if "nothing" in hidden:
        adequate = fraction[hidden.index("nothing"), named.index("adequate")] if "adequate" in named else 0.0
        alarms = round((1 - adequate) * totals["nothing"])
        said += f"{'; ' if said else ''}{alarms} false alarms in {totals['nothing']} with nothing hidden"
    return said


def _broken(name: str) -> str:
    """Break a long name into two lines."""
    for sign in (".", " ", "_"):
        if sign in name and len(name) > 14:
            first, _, last = name.partition(sign)
            return f"{first}{sign if sign == '.' else ''}\n{last}"
    return name
