"""Render images that test what rows suggest.

These are fresh configurations inside rules, configurations along one factor from a
failure, and failures once more.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch

from advsearch.extend import (
    InputError,
    RunContext,
    RunDirectory,
    SweepConfig,
    errors,
    results,
    rules,
    seeds,
    workbench,
)
from advsearch.questions.explain.clusters import find_clusters
from advsearch.questions.explain.findings import count_right
from advsearch.questions.explain.result import (
    Confirmation,
    FailureCluster,
    FailureClusters,
    NearestRight,
)
from advsearch.questions.explain.rows import read_predictions, read_values
from advsearch.questions.explain.sweeps import (
    is_sampled,
    is_settable,
    make_sweep_along,
    make_sweep_inside,
)

MAX_ARCS = 2
"""Maximum number of arcs of a condition on an angle."""
MIN_UNCOVERED_FRACTION = 0.2
"""Lower limit of the fraction of a rule's rows that no earlier rule covers.

The number of configurations to render is divided by this fraction, so that enough of
them are left.
"""


@dataclass
class SweepRunner:
    """Runs sweeps in the directory of the run, until it is interrupted.

    Attributes:
        context: context of the experiment.
        sweeps: sweeps whose rows are explained.
        rows: their rows with all columns.
        factor_table: the same rows with the columns of the parameters that vary.
            `attrs["units"]` maps these parameters, the factors, to their units.
        n_renders: number of images that were rendered.
        interrupted: whether Ctrl-C has ended the renders.
        warnings: sentences about renders that failed.
    """

    context: RunContext[Any]
    sweeps: Sequence[workbench.StoredSweep]
    rows: pd.DataFrame
    factor_table: pd.DataFrame
    n_renders: int = 0
    interrupted: bool = False
    warnings: list[str] = field(default_factory=list)
    _rendered: dict[str, workbench.StoredSweep] = field(default_factory=dict)
    _errors: set[str] = field(default_factory=set)
    _tried_failures: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.config = self.context.config
        self.progress = self.context.progress

    @property
    def pairs_sought(self) -> int:
        """The number of failures for which images were rendered to find a pair."""
        return len(self._tried_failures)

    def run_sweep(self, name: str, config: SweepConfig) -> pd.DataFrame | None:
        """Run a sweep and return its rows.

        If its scene is no longer available, a warning is added. After an interrupt, no
        further sweep is run.

        Args:
            name: name of the run in the directory of this experiment.
            config: settings of the sweep.

        Returns:
            The rows; None if the sweep was interrupted or could not be rendered.
        """
        if self.interrupted:
            return None
        if self.config.threads:
            config = config.model_copy(update={"threads": self.config.threads})
        try:
            self.context.run_part(name, config)
        except InputError as error:
            self._warn_about_sweep(name, error)
            return None
        sweep = self._read_finished_part(name)
        return None if self.interrupted else read_predictions([sweep])

    def _read_finished_part(self, name: str) -> workbench.StoredSweep:
        """Read a sweep that has ended, and count its renders.

        `interrupted` is set if it ended by Ctrl-C.

        Args:
            name: name of the run in the directory of this experiment.
        """
        path = RunDirectory.locate_part(self.context.run.path, name)
        sweep = workbench.StoredSweep.read(path)
        self._rendered[name] = sweep
        self.interrupted = sweep.summary.is_unfinished
        self.n_renders += sum(sweep.summary.renders.values())
        return sweep

    def _warn_about_sweep(self, name: str, error: InputError) -> None:
        """Add a warning that a sweep could not be rendered.

        The same error, such as a missing scene, is reported only once.
        """
        if str(error) not in self._errors:
            self._errors.add(str(error))
            self.warnings.append(f"Nothing was rendered for {name}: {error}")

    # ---- rules
    # ------------------------------------------------------------------------------

    def confirm_rule(
        self, counted_rules: Sequence[rules.CountedRule], index: int
    ) -> Confirmation | None:
        """Confirm a rule by fresh configurations that no earlier rule covers.

        They are rendered in the scene of each sweep. The rule is confirmed if the fresh
        rows inside it are wrong significantly more often than the old rows elsewhere.

        Args:
            counted_rules: all rules, in their order.
            index: index of the rule.

        Returns:
            The counts of the fresh rows; None if nothing was rendered.
        """
        if not self.config.confirm:
            return None
        rule = counted_rules[index]
        earlier_conditions = [earlier.conditions for earlier in counted_rules[:index]]
        fresh_frames = self._render_inside(index, rule, earlier_conditions)
        fresh_rows = pd.concat(fresh_frames) if fresh_frames else self.rows[:0]
        if fresh_rows.empty:
            return None
        # Draws of fresh rows have names ("12 of 3"). The old draws get names, too
        # ("12"), so that no old draw is taken for a fresh one.
        elsewhere = rule.elsewhere.assign(unit=rule.elsewhere["unit"].astype(str))
        # `holds` compares the fresh rows inside with the old rows elsewhere.
        fresh_rule = rules.CountedRule(rule.conditions, fresh_rows, elsewhere)
        return Confirmation(**vars(count_right(fresh_rows)), confirmed=fresh_rule.holds)

    def _estimate_uncovered_fraction(
        self,
        conditions: rules.RuleConditions,
        earlier_conditions: Sequence[rules.RuleConditions],
    ) -> float:
        """Return the fraction of a rule's rows that no earlier rule covers.

        At least `MIN_UNCOVERED_FRACTION`, which limits the number of renders.

        Args:
            conditions: conditions of the rule.
            earlier_conditions: conditions of the rules before it.
        """
        covered_rows = self.factor_table[
            rules.find_covered(conditions, self.factor_table)
        ]
        is_uncovered = find_uncovered(earlier_conditions, covered_rows)
        return max(float(is_uncovered.mean()), MIN_UNCOVERED_FRACTION)

    def _render_inside(
        self,
        index: int,
        rule: rules.CountedRule,
        earlier_conditions: Sequence[rules.RuleConditions],
    ) -> list[pd.DataFrame]:
        """Render fresh configurations inside a rule in the scene of each sweep.

        A condition on an angle may have two opposite arcs of the circle, such as 10 to
        30 and 190 to 210 degrees. Then there is a sweep for each arc.

        Args:
            index: index of the rule.
            rule: the rule.
            earlier_conditions: conditions of the rules before it.

        Returns:
            The rows of each sweep. Their draws (column `unit`) have texts as names,
            which are distinct from those of other sweeps.
        """
        # Fresh rows that earlier rules cover are left out afterwards. The smaller the
        # fraction of the others, the more configurations are rendered.
        uncovered_fraction = self._estimate_uncovered_fraction(
            rule.conditions, earlier_conditions
        )
        fresh_frames = []
        for sweep_index, sweep in enumerate(self.sweeps):
            n_arcs = count_arcs(sweep.config, rule.conditions)
            # `confirm` is the number of rows of a rule that no earlier rule covers. It
            # is divided evenly among sweeps and arcs.
            samples = math.ceil(
                self.config.confirm / len(self.sweeps) / n_arcs / uncovered_fraction
            )
            for arc in range(n_arcs):
                rows = self._render_arc(index, rule, sweep_index, arc, samples)
                # None after an interrupt, or if nothing could be rendered
                if rows is not None:
                    inside = select_inside(rows, rule.conditions, earlier_conditions)
                    number = self._number_sweep(index, sweep_index, arc)
                    fresh_frames.append(_name_fresh_draws(inside, number))
        return fresh_frames

    def _number_sweep(self, index: int, sweep_index: int, arc: int) -> int:
        """Return a number that is distinct for each rule, sweep and arc."""
        return (index * len(self.sweeps) + sweep_index) * MAX_ARCS + arc

    def _render_arc(
        self,
        index: int,
        rule: rules.CountedRule,
        sweep_index: int,
        arc: int,
        samples: int,
    ) -> pd.DataFrame | None:
        """Render configurations inside a rule in the scene of a sweep; return the rows.

        None after an interrupt, or if nothing could be rendered.

        Args:
            index: index of the rule.
            rule: the rule.
            sweep_index: index of the sweep.
            arc: index of the arc of conditions on angles.
            samples: number of configurations.
        """
        self.progress.message(
            f"rule {index + 1}: rendering about {samples} configurations inside it"
        )
        number = self._number_sweep(index, sweep_index, arc)
        config = make_sweep_inside(
            self.sweeps[sweep_index].config,
            self.factor_table,
            rule.conditions,
            samples,
            seed=seeds.derive_seed(self.config.seed, "confirm", number),
            arc=arc,
        )
        suffix = f"-{arc}" if arc else ""
        return self.run_sweep(f"rule-{index + 1}-{sweep_index}{suffix}", config)

    # ---- pairs
    # ------------------------------------------------------------------------------

    def find_pairs(
        self, counted_rules: Sequence[rules.CountedRule]
    ) -> Iterator[NearestRight]:
        """Yield for typical failures the nearest configuration that is predicted right.

        A failure may have no such configuration.

        Args:
            counted_rules: all rules, in their order.
        """
        failures = find_typical_failures(
            self.factor_table, counted_rules, self.config.pairs
        )
        for number, (index, conditions) in enumerate(failures, start=1):
            pair = self._find_pair(f"pair-{number}", index, conditions)
            if pair is not None:
                yield pair

    def _find_pair(
        self, name: str, index: int, conditions: rules.RuleConditions
    ) -> NearestRight | None:
        """Return the nearest configuration to a failure that is predicted right.

        That configuration differs from the failure in one parameter. First all
        parameters of the failure's rule are tried, and the one with the smallest
        relative change is used. If none of these makes the prediction right, the other
        parameters are tried one by one, and the first one that does is used. If none
        does, the failure has no pair.

        Args:
            name: name of the pair, such as "pair-3".
            index: index of the failure among the rows.
            conditions: conditions of the failure's rule.
        """
        for factors in self._group_factors(conditions):
            attempts = [
                self._find_nearest_right(name, index, factor) for factor in factors
            ]
            pairs = [pair for pair in attempts if pair is not None]
            if pairs:
                return min(pairs, key=self._relative_change)
        return None

    def _group_factors(self, conditions: rules.RuleConditions) -> list[list[str]]:
        """Return all factors of a rule as one group, then each other factor by itself."""
        rule_factors = [condition.factor for condition in conditions]
        other_factors = [
            factor
            for factor in self.factor_table.attrs["units"]
            if factor not in rule_factors
        ]
        return [rule_factors, *([factor] for factor in other_factors)]

    def _relative_change(self, pair: NearestRight) -> float:
        """Return the difference of a pair as a fraction of the factor's range.

        Names have no distance: the difference of two names is 1.
        """
        column = self.factor_table[pair.parameter]
        if column.dtype == "category":
            return 1.0
        # not 0, as the columns of this table vary
        value_range = float(column.max() - column.min())
        return abs(float(pair.right_at) - float(pair.wrong_at)) / value_range

    def _find_nearest_right(
        self, name: str, index: int, factor: str
    ) -> NearestRight | None:
        """Find the nearest value of a factor at which a failure is predicted right.

        The failure is rendered at values along the factor, twice, with different noise.
        The model has to be wrong in both renders at the failure's own value, and right
        in both at the other value.

        Args:
            name: name of the pair, such as "pair-3".
            index: index of the failure among the rows.
            factor: the parameter that varies; everything else is as in the failure.

        Returns:
            The pair; None if there is no such value, or nothing could be rendered.
        """
        config = self.sweeps[self.rows["sweep"][index]].config
        if not is_settable(config, factor):
            return None
        failure = read_values(self.rows, index)
        self.progress.message(f"{name}: the nearest right prediction along {factor}")
        run_name = f"{name}-{factor.replace('.', '_')}"
        frames = self._render_twice(run_name, config, failure, factor)
        if frames is None:
            return None
        self._tried_failures.add(index)  # counted in `pairs_sought`

        rows = self._find_pair_rows(frames, factor, failure[factor])
        if rows is None:
            return None
        # images of the first of both renders
        pictures = self._list_thumbnails(f"{run_name}-0", rows)
        return self._make_nearest_right(frames[0], rows, failure, factor, pictures)

    def _make_nearest_right(
        self,
        frame: pd.DataFrame,
        rows: tuple[int, int],
        failure: dict[str, float | str],
        factor: str,
        pictures: list[str],
    ) -> NearestRight:
        """Describe a failure and the nearest configuration that is predicted right.

        Args:
            frame: rows of configurations along the factor.
            rows: indices of the failure and of the other configuration.
            failure: values of the failure by parameter.
            factor: the parameter that varies.
            pictures: files of both images.
        """
        failure_row, nearest_row = rows
        return NearestRight(
            values=failure,
            parameter=factor,
            unit=self.factor_table.attrs["units"][factor],
            wrong_at=failure[factor],
            right_at=frame[factor].tolist()[nearest_row],
            failure_label=frame["label"][failure_row],
            right_label=frame["label"][nearest_row],
            pictures=pictures,
        )

    def _find_pair_rows(
        self, frames: Sequence[pd.DataFrame], factor: str, wrong_value: float | str
    ) -> tuple[int, int] | None:
        """Return the indices of a failure and of the nearest right value along a factor.

        None if there is no such value, or if the failure is predicted right once.

        Args:
            frames: rows of the same configurations along the factor, with different noise.
            factor: the parameter that varies.
            wrong_value: the failure's own value, which is among them.
        """
        frame_a, frame_b = frames
        values = frame_a[factor].tolist()
        failure_row = values.index(wrong_value)
        is_right_in_both = np.asarray(frame_a["correct"] & frame_b["correct"])
        is_right_in_any = np.asarray(frame_a["correct"] | frame_b["correct"])
        if is_right_in_any[failure_row] or not is_right_in_both.any():
            return None
        nearest_row = self._find_nearest_value(
            factor, is_right_in_both, values, wrong_value
        )
        return failure_row, nearest_row

    def _render_twice(
        self,
        run_name: str,
        config: SweepConfig,
        failure: dict[str, float | str],
        factor: str,
    ) -> list[pd.DataFrame] | None:
        """Render a failure along a factor, twice with different noise.

        Args:
            run_name: name of the runs, to which 0 and 1 are added.
            config: settings of the sweep that the failure is from.
            failure: values of the failure by parameter.
            factor: the parameter that varies.

        Returns:
            The rows of both; None if it was interrupted, or nothing could be rendered.
        """
        frames = []
        for repeat in range(2):
            seed = seeds.derive_seed(self.config.seed, f"{run_name} {repeat}")
            sweep = make_sweep_along(config, failure, factor, self.factor_table, seed)
            rows = self.run_sweep(f"{run_name}-{repeat}", sweep)
            if rows is None:
                return None
            frames.append(rows)
        return frames

    def _find_nearest_value(
        self, factor: str, is_right: rules.Mask, values: Sequence[Any], wrong_value: Any
    ) -> int:
        """Return the index of the value that is predicted right and nearest to a value.

        Names have no distance: for names, it is the first one that is predicted right.

        Args:
            factor: factor that has the values.
            is_right: whether the prediction at each value is right.
            values: numbers or names.
            wrong_value: the value of the failure, which is among them.
        """
        right_indices = np.flatnonzero(is_right).tolist()
        if self.factor_table[factor].dtype == "category":
            return int(right_indices[0])
        nearest_index: int = min(
            right_indices,
            key=lambda index: abs(float(values[index]) - float(wrong_value)),
        )
        return nearest_index

    def _list_thumbnails(self, name: str, numbers: Sequence[int]) -> list[str]:
        """Return paths of stored images of a sweep, relative to the run directory.

        Empty if the sweep was not rendered; images that were not stored are left out.

        Args:
            name: name of the sweep in the directory of this experiment.
            numbers: indices of the images.
        """
        sweep = self._rendered.get(name)
        if sweep is None:
            return []
        files = [sweep.find_thumbnail(number) for number in numbers]
        return [
            str(file.relative_to(self.context.run.path))
            for file in files
            if file is not None
        ]

    # ---- clusters
    # ------------------------------------------------------------------------------

    def find_clusters(self) -> FailureClusters | None:
        """Render failures of one model again, and cluster them by its features.

        None if no clusters were requested, or if there are no failures. None, too, if
        they could not be rendered; then a warning is added.
        """
        selected = self._select_sweeps()
        failing = self.rows[~self.rows["correct"] & self.rows["sweep"].isin(selected)]
        # Without a selected sweep there are no failures.
        if self.interrupted or not self.config.clusters or failing.empty:
            return None
        self._warn_about_selection(selected)
        sampled = self._sample_failures(failing)
        self.progress.stage(
            "rendering failures again", len(sampled), hint="`clusters` sets how many"
        )
        rendered = self._render_failures(sampled)
        if rendered is None:
            return None
        images, compute_features = rendered
        return self._cluster_failures(sampled, images, compute_features)

    def _cluster_failures(
        self, sampled: pd.DataFrame, images: torch.Tensor, compute_features: Any
    ) -> FailureClusters:
        """Cluster rendered failures by the features of the model.

        Args:
            sampled: their rows.
            images: their images (n, H, W, 3).
            compute_features: function from images to features.
        """
        clusters = find_clusters(
            compute_features(images).double().numpy(), self.config.seed
        )
        # The first member of a cluster is the most typical one. Members are indices of
        # both the images and the sampled rows.
        described_clusters = [
            self._describe_cluster(
                number, sampled.iloc[list(members)], images[members[0]]
            )
            for number, members in enumerate(clusters.members, start=1)
        ]
        return FailureClusters(
            features=compute_features.source_description,
            failures=len(sampled),
            silhouette=clusters.silhouette,
            are_separated=clusters.are_separated,
            listed=described_clusters,
        )

    def _render_failures(
        self, sampled: pd.DataFrame
    ) -> tuple[torch.Tensor, Any] | None:
        """Render failures of one model again.

        Args:
            sampled: their rows, sorted by sweep.

        Returns:
            The images (n, H, W, 3) in the order of the rows, and the function that
            computes the model's features. None if the user has interrupted it, or if
            an image could not be rendered; then a warning is added.
        """
        try:
            # After Ctrl-C this block ends, and `ending` is set.
            with self.context.until_interrupted():
                # The column `step` has the index of the image in its sweep.
                batches = [
                    self.render_again(self.sweeps[index], rows["step"].tolist())
                    for index, rows in sampled.groupby("sweep")
                ]
        except (InputError, errors.ModelError) as error:
            self.warnings.append(f"No failures were grouped: {error}")
            return None
        if self.context.ending == results.INTERRUPTED:
            self.interrupted = True
            return None
        self.n_renders += len(sampled)
        return _join_batches(batches)

    def _warn_about_selection(self, selected: Sequence[int]) -> None:
        """Add a warning if not all sweeps have failures of the clustered model.

        Args:
            selected: indices of the sweeps with that model, at least one.
        """
        if len(selected) < len(self.sweeps):
            name = self.sweeps[selected[0]].config.model
            self.warnings.append(
                f"Only failures of model {name} were clustered, from sweeps of this "
                "model alone."
            )

    def _sample_failures(self, failing: pd.DataFrame) -> pd.DataFrame:
        """Sample at most `clusters` failures at random, in their order."""
        generator = np.random.default_rng(
            seeds.derive_seed(self.config.seed, "clusters")
        )
        sampled = generator.permutation(len(failing))[: self.config.clusters]
        return failing.iloc[np.sort(sampled)]

    def _describe_cluster(
        self, number: int, rows: pd.DataFrame, image: torch.Tensor
    ) -> FailureCluster:
        """Describe a cluster by its rows, and store its typical image.

        Args:
            number: number of the cluster, from 1.
            rows: rows of its failures, the most typical first.
            image: (H, W, 3) image of the most typical one.
        """
        path = self.context.run.save_image(f"cluster-{number}", image)
        return FailureCluster(
            failures=len(rows),
            labels=dict(Counter(rows["label"]).most_common()),
            values=read_values(rows, rows.index[0]),
            picture=str(path.relative_to(self.context.run.path)),
        )

    def _select_sweeps(self) -> list[int]:
        """Return the indices of the sweeps whose failures are clustered.

        Features are those of one model: the first one that has a sweep with no other
        model. If there is none, no sweep is selected.
        """
        models_of_sweeps = [sweep.config.models for sweep in self.sweeps]
        single_models = [names for names in models_of_sweeps if len(names) == 1]
        if not single_models:
            return []
        return [
            index
            for index, names in enumerate(models_of_sweeps)
            if names == single_models[0]
        ]

    def render_again(
        self, sweep: workbench.StoredSweep, numbers: Sequence[int]
    ) -> tuple[torch.Tensor, Any]:
        """Render images of a sweep of one model again.

        Args:
            sweep: the sweep.
            numbers: indices of the images in the sweep.

        Returns:
            The images (n, H, W, 3) as the model sees them, and the function that
            computes its features.

        Raises:
            InputError: the scene is no longer available, or the task is not
                classification (raised by `find_features`).
        """
        # a function from images to features
        compute_features = sweep.scenes.find_features()
        images = []
        for number in numbers:
            images.append(sweep.scenes.render_image(number))
            self.progress.advance(1)
        return torch.stack(images), compute_features


def _join_batches(
    batches: Sequence[tuple[torch.Tensor, Any]],
) -> tuple[torch.Tensor, Any]:
    """Return the images (n, H, W, 3) of all batches, and the function of the features.

    All batches have the same function, since there is one model.
    """
    images = torch.cat([batch_images for batch_images, _ in batches])
    _, compute_features = batches[0]
    return images, compute_features


def _name_fresh_draws(rows: pd.DataFrame, number: int) -> pd.DataFrame:
    """Return rows of a sweep with names of their draws, such as "12 of 3".

    Draws of other sweeps may have the same indices: with the sweep's number their names
    differ.
    """
    return rows.assign(unit=rows["unit"].astype(str) + f" of {number}")


def count_arcs(config: SweepConfig, conditions: rules.RuleConditions) -> int:
    """Return the number of sweeps that cover the arcs of conditions on angles.

    A condition on an angle may have two opposite arcs of the circle, each of which
    needs a sweep. Conditions on other factors have no arcs, and need one sweep. If two
    angles have two arcs each, two sweeps are used, too: `cut_controls` combines the
    first arcs in one of them and the second arcs in the other. The other two
    combinations are not rendered.
    """
    # The range of a factor that is not sampled is not cut to arcs.
    n_arcs = [
        len(condition.arcs)
        for condition in conditions
        if is_sampled(config, condition.factor)
    ]
    return max([1, *n_arcs])


def select_inside(
    rows: pd.DataFrame,
    conditions: rules.RuleConditions,
    earlier_conditions: Sequence[rules.RuleConditions],
) -> pd.DataFrame:
    """Return the rows of a rule that no earlier rule covers.

    Rows in which the object is out of view are left out.
    """
    is_inside = rules.find_covered(conditions, rows) & find_uncovered(
        earlier_conditions, rows
    )
    return rows[is_inside & rules.is_in_view(rows)]


def find_uncovered(
    rule_conditions: Sequence[rules.RuleConditions], rows: pd.DataFrame
) -> rules.Mask:
    """Return whether each row is covered by no rule, (n,) bool."""
    is_uncovered = np.ones(len(rows), np.bool_)
    for conditions in rule_conditions:
        is_uncovered &= ~rules.find_covered(conditions, rows)
    return is_uncovered


def find_typical_failures(
    table: pd.DataFrame, counted_rules: Sequence[rules.CountedRule], limit: int
) -> list[tuple[int, rules.RuleConditions]]:
    """Return the indices of failures, the most typical first, each with its rule.

    A failure belongs to the group of the first rule that covers it. Failures that no
    rule covers form a last group, without conditions. The most typical failure of a
    group is the one nearest to the mean of the group, where the values of parameters
    are replaced by their ranks. The list has the most typical failure of each group,
    then the second one of each, and so on.

    Args:
        table: the rows.
        counted_rules: the rules.
        limit: maximum number of failures that are returned.
    """
    failures = []
    # the most typical failure of each group, then the second one of each, and so on
    for failures_of_groups in zip_longest(*_group_failures(table, counted_rules)):
        # `zip_longest` yields None for a group that has no more failures.
        failures += [failure for failure in failures_of_groups if failure is not None]
    return failures[:limit]


def _group_failures(
    table: pd.DataFrame, counted_rules: Sequence[rules.CountedRule]
) -> list[list[tuple[int, rules.RuleConditions]]]:
    """Return the failures of each rule that no earlier rule covers, then the others.

    In each group the failures nearest to its mean come first.

    Args:
        table: the rows.
        counted_rules: the rules.
    """
    ranks = _rank_rows(table)  # (n, parameters)
    is_unassigned: rules.Mask = ~table["correct"].to_numpy()
    no_conditions: rules.RuleConditions = ()  # these cover every row
    group_conditions = [*(rule.conditions for rule in counted_rules), no_conditions]
    groups = []
    for conditions in group_conditions:
        is_in_group = is_unassigned & rules.find_covered(conditions, table)
        indices = np.flatnonzero(is_in_group)
        is_unassigned[indices] = False
        if not len(indices):
            continue
        order = _sort_by_distance_from_mean(ranks[indices])
        groups.append([(index, conditions) for index in indices[order].tolist()])
    return groups


def _sort_by_distance_from_mean(ranks: rules.FloatArray) -> npt.NDArray[np.intp]:
    """Return the order of rows (n, parameters) by their distance from the mean row."""
    distance = np.abs(ranks - ranks.mean(axis=0)).sum(axis=1)
    return np.argsort(distance, kind="stable")


def _rank_rows(table: pd.DataFrame) -> rules.FloatArray:
    """Return the rank of each row in each parameter, (n, parameters), as a fraction.

    Rows with equal values have different ranks.
    """
    parameters = list(table.attrs["units"])
    columns = [table[name] for name in parameters]
    # Names are ranked by the index of their category.
    values = [
        column.cat.codes if column.dtype == "category" else column for column in columns
    ]
    # `argsort` of `argsort` is the rank: the position of each row in the sorted column.
    order = np.stack(values, axis=1).astype(np.float64).argsort(axis=0)
    return order.argsort(axis=0) / len(table)
