"""Intervals, tests and agreement: over objects by clustered bootstrap, over training seeds by t and sign flips.

*Would a result hold on other objects?*  Resample the objects, flip their signs.  *Would it hold for other training
runs?*  Compare the means of the seeds, paired by seed.  All intervals are two-sided.
"""

import dataclasses
import itertools
import math
from typing import Literal

import numpy as np
from scipy import special

TAILS = (0.025, 0.975)
"""Quantiles that every interval spans: it covers 95 %."""

EXACT_LIMIT = 16
"""Up to this many differences the sign-flip test enumerates all 2^n sign patterns."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Interval:
    """A point estimate and its confidence interval."""

    mean: float
    low: float
    high: float

    @property
    def excludes_zero(self) -> bool:
        """True if 0 lies outside the interval."""
        return self.low > 0 or self.high < 0


def clustered_bootstrap(
    values: np.ndarray,
    clusters: np.ndarray,
    *,
    strata: np.ndarray | None = None,
    resamples: int = 10_000,
) -> Interval:
    """Percentile interval of a mean when values of one object are not independent: whole objects are resampled.

    With C clusters, draw w ~ Multinomial(C, 1/C) and take θ* = mean_s (Σ_c w_c Σ_cs) / (Σ_c w_c n_cs), where Σ_cs and
    n_cs are the sum and the number of the values of cluster c in stratum s; a stratum that a resample misses is left
    out of that resample's mean.  The interval spans the .025 and .975 quantiles of θ*.  The difference of two policies
    on the same answers is `clustered_bootstrap(a - b, ...)`.

    Args:
      values: float [M], finite.
      clusters: [M], the object of each value.
      strata: int [M], see `metrics.Scores`; `None` for the plain mean.

    Raises:
      ValueError: lengths differ, a value is not finite, or fewer than two clusters.

    Source: Davison and Hinkley, Bootstrap Methods and their Application (1997), §3.8 (resampling clusters), §5.3.
    """
    strata = np.zeros(len(values), int) if strata is None else strata
    _check_values(values, clusters, strata)
    cluster, weights = draw_clusters(clusters, resamples=resamples)
    low, high = np.quantile(drawn_means(values, cluster, strata, weights), TAILS)
    mean = np.mean([values[strata == s].mean() for s in np.unique(strata)])
    return Interval(mean=float(mean), low=float(low), high=float(high))


def draw_clusters(objects: np.ndarray, *, resamples: int) -> tuple[np.ndarray, np.ndarray]:
    """Resamples of whole objects that several metrics share, so that a function of them has an interval.

    Args:
      objects: [N], the object of each question.

    Returns:
      The number of each question's object, int [N], and how often each resample holds each object, [resamples, C].

    Raises:
      ValueError: fewer than two objects.
    """
    cluster = numbered(objects)
    number = int(cluster.max()) + 1
    return cluster, np.random.default_rng(0).multinomial(number, np.full(number, 1 / number), size=resamples)


def numbered(objects: np.ndarray) -> np.ndarray:
    """The number of each object among all of them, int [N].

    Raises:
      ValueError: fewer than two objects.
    """
    names, number = np.unique(objects, return_inverse=True)
    if len(names) < 2:
        raise ValueError(f"objects holds {len(names)}: an interval over objects needs two; ask about more objects")
    return number


def drawn_means(values: np.ndarray, cluster: np.ndarray, strata: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """A metric in every resample that `draw_clusters` drew, NaN where a resample holds none of its values, [resamples].

    Args:
      values: float [M].
      cluster: int [M], the number of each value's object.
      strata: int [M], see `metrics.Scores`.
      weights: int [resamples, C].

    Raises:
      ValueError: a value that is not finite, which would take its stratum out.
    """
    _check_finite(values=values)
    means = []
    for s in np.unique(strata):
        at = strata == s
        sums = np.bincount(cluster[at], weights=values[at], minlength=weights.shape[1])
        seen = weights @ np.bincount(cluster[at], minlength=weights.shape[1])
        means.append(np.where(seen > 0, weights @ sums / np.maximum(seen, 1), np.nan))
    table = np.stack(means)
    known = np.isfinite(table).sum(axis=0)
    return np.where(known > 0, np.nansum(table, axis=0) / np.maximum(known, 1), np.nan)


def student_interval(values: np.ndarray) -> Interval:
    """x̄ ± t_{n−1, .975} · s/√n over n independent training runs; give paired differences to compare two arms.

    Args:
      values: float [n], finite, n ≥ 2.  At n = 5 the factor is 2.776.

    Source: Student, The probable error of a mean, Biometrika 6 (1908).
    """
    n = len(values)
    if n < 2:
        raise ValueError(f"values holds {n}: an interval over seeds needs two at least; train more seeds")
    _check_finite(values=values)
    half = float(special.stdtrit(n - 1, TAILS[1])) * float(np.std(values, ddof=1)) / math.sqrt(n)
    mean = float(np.mean(values))
    return Interval(mean=mean, low=mean - half, high=mean + half)


def interquartile_mean(scores: np.ndarray) -> float:
    """IQM: the mean of the scores left after dropping ⌊n/4⌋ at either end.

    Args:
      scores: float, any shape, pooled over runs and tasks.

    Source: Agarwal et al., Deep RL at the Edge of the Statistical Precipice (2021), §4.3; rounding as in `rliable`.
    """
    _check_finite(scores=scores)
    ordered = np.sort(scores, axis=None)
    cut = ordered.size // 4
    return float(ordered[cut : ordered.size - cut].mean())


def stratified_bootstrap_iqm(scores: np.ndarray, *, resamples: int = 2_000) -> Interval:
    """Percentile interval of the IQM when the runs of each task are resampled on their own.

    Args:
      scores: float [runs, tasks]; the tasks are the strata.

    Raises:
      ValueError: fewer than two runs.

    Source: Agarwal et al. (2021), §4.1 (stratified bootstrap).
    """
    middle, (runs, tasks) = interquartile_mean(scores), scores.shape
    _check_runs(scores=scores)
    pick = np.random.default_rng(0).integers(runs, size=(resamples, runs, tasks))
    ordered = np.sort(scores[pick, np.arange(tasks)].reshape(resamples, -1), axis=1)
    cut = ordered.shape[1] // 4
    low, high = np.quantile(ordered[:, cut : ordered.shape[1] - cut].mean(axis=1), TAILS)
    return Interval(mean=middle, low=float(low), high=float(high))


def probability_of_improvement(better: np.ndarray, than: np.ndarray) -> float:
    """Mean over tasks of P(X > Y) + ½ P(X = Y), X a run of one policy and Y a run of the other.

    Args:
      better, than: float [runs, tasks] and [runs', tasks], higher is better (negate errors).

    Source: Agarwal et al. (2021), §4.3; the Mann–Whitney statistic over n·n′.
    """
    if better.shape[1:] != than.shape[1:]:
        raise ValueError(f"shapes are {better.shape} and {than.shape}: the tasks must be the same; align the columns")
    _check_finite(better=better, than=than)
    x, y = better[:, None], than[None]
    return float(np.mean((x > y) + 0.5 * (x == y)))


def improvement_interval(better: np.ndarray, than: np.ndarray, *, resamples: int = 2_000) -> Interval:
    """Percentile interval of the probability of improvement when the runs of each task are resampled on either side.

    Args:
      better, than: float [runs, tasks] and [runs', tasks], as for `probability_of_improvement`.

    Raises:
      ValueError: as `probability_of_improvement`, or fewer than two runs on either side.

    Source: Agarwal et al. (2021), §4.1 and §4.3; the two sides are resampled separately, as in `rliable`.
    """
    point = probability_of_improvement(better, than)
    _check_runs(better=better, than=than)
    rng, tasks = np.random.default_rng(0), np.arange(better.shape[1])
    x, y = (a[rng.integers(0, len(a), (resamples, *a.shape)), tasks] for a in (better, than))
    x, y = x[:, :, None], y[:, None]
    low, high = np.quantile(((x > y) + 0.5 * (x == y)).mean(axis=(1, 2, 3)), TAILS)
    return Interval(mean=point, low=float(low), high=float(high))


def sign_flip_test(differences: np.ndarray) -> float:
    """Two-sided p-value of "the paired differences are symmetric about 0".

    p = share of sign patterns ε ∈ {−1, 1}^n with |mean(ε·d)| ≥ |mean(d)|, all 2^n of them up to n = 16, else a random
    sample of 20,000 with (1 + hits)/20,001.  It cannot fall below 2^{1−n}: five seeds reach .0625 at best.

    Args:
      differences: float [n].

    Source: Fisher, The Design of Experiments (1935), §21; Phipson and Smyth (2010) for the +1.
    """
    n = len(differences)
    _check_finite(differences=differences)
    exact = n <= EXACT_LIMIT
    if exact:
        signs = np.array(list(itertools.product((1.0, -1.0), repeat=n)))
    else:
        signs = np.random.default_rng(0).choice((1.0, -1.0), size=(20_000, n))
    observed = abs(differences.sum())
    hits = int(np.sum(np.abs(signs @ differences) >= observed - 1e-12 * (1 + observed)))
    return hits / len(signs) if exact else (1 + hits) / (1 + len(signs))


def crossed_test(differences: np.ndarray, clusters: np.ndarray, *, strata: np.ndarray | None = None) -> float:
    """Two-sided p-value of "no difference" for other training runs and other objects at once: five seeds can reject it.

    Student's t of the mean over S strata, V = max(V_seeds + V_objects − V_both, V_seeds, V_objects), with one degree of
    freedom fewer than seeds; each V sums the squares of the shares of its clusters, V_both those of one object in
    one seed.

    Args:
      differences: float [seeds, M], paired by answer.
      clusters: [M], the object of each answer.
      strata: int [M], as for `clustered_bootstrap`.

    Raises:
      ValueError: as `clustered_bootstrap`, or fewer than two seeds.

    Source: Cameron, Gelbach and Miller, Robust inference with multiway clustering (2011), eq. 2.8 and §2.3; the maximum
    keeps V from falling below either of its parts.
    """
    seeds = len(differences)
    if seeds < 2:
        raise ValueError(f"differences holds {seeds} seeds: a test over seeds needs two at least; train more seeds")
    strata = np.zeros(differences.shape[1], int) if strata is None else strata
    _check_values(differences.mean(axis=0), clusters, strata)
    _, stratum, counts = np.unique(strata, return_inverse=True, return_counts=True)
    cluster = numbered(clusters)
    weight = 1 / (len(counts) * counts[stratum] * seeds)
    means = np.bincount(stratum, weights=differences.mean(axis=0)) / counts
    mean = float(means.mean())
    shares = np.array([np.bincount(cluster, weights=row) for row in weight * (differences - means[stratum])])
    of_seeds, of_objects, of_both = (
        float(np.sum(s**2)) * s.size / (s.size - 1) for s in (shares.sum(axis=1), shares.sum(axis=0), shares)
    )
    deviation = math.sqrt(max(of_seeds + of_objects - of_both, of_seeds, of_objects))
    if deviation == 0:
        return float(mean == 0)
    return 2 * float(special.stdtr(min(shares.shape) - 1, -abs(mean) / deviation))


def holm(p_values: np.ndarray) -> np.ndarray:
    """Holm's step-down adjustment: p̃_(i) = max_{j ≤ i} min(1, (m − j + 1)·p_(j)), in the order given.

    Args:
      p_values: float [m].

    Source: Holm, A simple sequentially rejective multiple test procedure (1979).
    """
    order = np.argsort(p_values, kind="stable")
    scaled = np.minimum(1.0, p_values[order] * np.arange(len(p_values), 0, -1))
    adjusted = np.empty(len(p_values))
    adjusted[order] = np.maximum.accumulate(scaled)
    return adjusted


def wilson_interval(passed: int, of: int) -> Interval:
    """A share and its score interval, (p̂ + z²/2n ± z √(p̂(1 − p̂)/n + z²/4n²)) / (1 + z²/n); never empty at 0 or 1.

    Args:
      passed: number that passed, 0..n.
      of: n ≥ 1.

    Raises:
      ValueError: such numbers are impossible.

    Source: Wilson, J. Am. Stat. Assoc. 22 (1927).
    """
    if not 0 <= passed <= of or of < 1:
        raise ValueError(f"passed is {passed} of {of}: must lie in 0..n with n ≥ 1; count again")
    z, p = float(special.ndtri(TAILS[1])), passed / of
    middle = (p + z * z / (2 * of)) / (1 + z * z / of)
    half = z * math.sqrt(p * (1 - p) / of + z * z / (4 * of * of)) / (1 + z * z / of)
    return Interval(mean=p, low=middle - half, high=middle + half)


def cohens_kappa(a: np.ndarray, b: np.ndarray, levels: int, *, weights: Literal["none", "quadratic"] = "none") -> float:
    """κ = 1 − Σ w_ij o_ij / Σ w_ij e_ij over the K × K table o of two raters, e the product of its margins.

    w_ij = 1[i ≠ j] without weights, (i − j)² with quadratic ones, which forgive the neighbouring level.

    Args:
      a, b: int [n], levels 0..K−1 of the same things.
      levels: K.

    Raises:
      ValueError: lengths differ or are 0, a level outside 0..K−1, or both raters gave everything the same one level,
        where κ is 0/0.

    Source: Cohen, Educ. Psychol. Meas. 20 (1960); the weights, Psychol. Bull. 70 (1968).
    """
    if not len(a) == len(b) or not len(a):
        raise ValueError(
            f"a and b have lengths {len(a)} and {len(b)}: they must be equal and ≥ 1; rate the same things"
        )
    both = np.concatenate([a, b])
    if both.min() < 0 or both.max() >= levels:
        raise ValueError(f"levels range from {both.min()} to {both.max()}: must lie in 0..{levels - 1}; correct them")
    table = np.zeros((levels, levels))
    np.add.at(table, (a, b), 1 / len(a))
    i = np.arange(levels)
    weight = (i[:, None] != i).astype(float) if weights == "none" else (i[:, None] - i) ** 2.0
    expected = float((weight * np.outer(table.sum(1), table.sum(0))).sum())
    if expected == 0:
        raise ValueError(f"both raters gave level {both[0]} throughout: κ is undefined; rate things that differ")
    return 1 - float((weight * table).sum()) / expected


def _check_values(values: np.ndarray, clusters: np.ndarray, strata: np.ndarray) -> None:
    if not len(values) == len(clusters) == len(strata):
        lengths = f"{len(values)}, {len(clusters)} and {len(strata)}"
        raise ValueError(f"values, clusters and strata have lengths {lengths}: they must be equal; align the arrays")
    _check_finite(values=values)


def _check_runs(**arrays: np.ndarray) -> None:
    """Refuse a single run, whose resamples are all alike: its interval would have no width."""
    for name, scores in arrays.items():
        if len(scores) < 2:
            raise ValueError(f"{name} holds {len(scores)} runs: an interval over runs needs two; train more seeds")


def _check_finite(**arrays: np.ndarray) -> None:
    """Refuse NaN, of which every comparison is false, so that it counts as a loss, and nothing, whose mean is NaN."""
    for name, values in arrays.items():
        if not np.size(values):
            raise ValueError(f"{name} is empty: must hold one number at least; leave it out, or measure it")
        finite = np.isfinite(values).ravel()
        if not finite.all():
            first = int(np.argmin(finite))
            raise ValueError(f"{name}[{first}] is {values.flat[first]}: must be finite; leave undefined ones out")


def skill(error: np.ndarray, reference: np.ndarray, objects: np.ndarray) -> Interval:
    """1 − Σ error / Σ reference over n contacts, with an interval over objects.

    Args:
      error, reference: [n] of the same contacts, reference > 0 in sum.
      objects: [n]; resamples of those alone whose reference has no error are left out.

    Raises:
      ValueError: a reference without error, for which no skill is defined, a number that is not finite, or fewer than
        two objects.
    """
    _check_finite(error=error, reference=reference)
    if not reference.sum() > 0:
        raise ValueError(f"reference sums to {reference.sum()}: must be > 0, or no skill is defined; choose another")
    group, weights = draw_clusters(objects, resamples=2_000)
    sums = np.zeros((weights.shape[1], 2))
    np.add.at(sums, group, np.stack([error, reference], 1).astype(float))
    drawn = weights @ sums
    drawn = drawn[drawn[:, 1] > 0]
    low, high = np.quantile(1 - drawn[:, 0] / drawn[:, 1], TAILS)
    return Interval(mean=float(1 - error.sum() / reference.sum()), low=float(low), high=float(high))
