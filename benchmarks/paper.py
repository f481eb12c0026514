"""
Write tables and figures of the page of results, ``results/README.md``, from the raw data in ``results/paper``::

    python -m benchmarks.paper [--add NAME FOLDER]

``--add`` first adds the finished cells of an experiment's folder to the raw data. Sentences of the page are written by
hand, outside the marks ``<!-- name -->`` and ``<!-- end -->``. Differences are in percent of the treasures.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from sb3_saf.experiments.definitions import METHODS, RANDOM
from sb3_saf.experiments.tables import (
    CURVES,
    MARGIN,
    RUNS,
    Difference,
    Frames,
    complete,
    holm,
    keys_of,
    marl_eval,
    mean_difference,
    read_results,
    variance_of_tests,
)
from sb3_saf.teams.files import write_text
from sb3_saf.training.figures import draw_curves, draw_differences
from sb3_saf.training.statistics import (
    FEWEST_SEEDS,
    Estimate,
    Floats,
    interquartile_means,
    mean_over_seeds,
    probability_of_improvement,
    score_matrices,
)

ROOT: Final = Path(__file__).resolve().parents[1]
RAW: Final = ROOT / "results" / "paper"
PAGES: Final = (ROOT / "results" / "README.md", RAW / "README.md", ROOT / "docs" / "algorithms" / "memory.md")
#: Tests at other levels than that of the training.
OTHER_LEVELS: Final = ("ood-coordination", "ood-heterogeneity")
#: The same for SAF without its parts.
OTHER_LEVELS_PARTS: Final = "ood-ablation"
#: SAF without its parts and in the paper's form, and MAPPO of its table, in settings of the grid.
PARTS: Final = "parts"
#: The experiments of the grid; others have settings of their own.
GRID: Final = ("coordination", "heterogeneity", "joint", *OTHER_LEVELS)
#: With a GRU, in settings of the grid.
MEMORY: Final = "memory"
#: The paper's number of game steps.
LENGTH: Final = "length10"
#: Every actor with every critic: names begin so.
FACTORIAL: Final = "factorial"
#: Zones as pixels, of the grid's length.
PIXELS: Final = ("pixels", "pixels_pool4")
#: SAF and MAPPO with zones as pixels, of seeds that were trained after the test of their difference had been declared.
FRESH: Final = "fresh_pixels"
#: Teams of ``benchmarks.scripted``, in words.
SCRIPTED: Final = {"7 x 7 views": "script, 7 x 7 views", "full sight": "script, sees all"}
#: Methods of the grid; SAF is compared with the others.
MAIN: Final = ("saf", "mappo", "ippo-separate", "ippo")
WORDS: Final = {
    **{name: method.words for name, method in METHODS.items()},
    **{f"{name}-gru": f"{METHODS[name].words}, GRU" for name in ("saf", "mappo", "ippo")},
}
#: What the parts are worth: first minus second.
PAIRS: Final = (
    ("saf", "saf-no-pool"),
    ("saf", "saf-no-ks"),
    ("saf", "saf-paper"),
    ("saf-paper", "mappo"),
    ("saf-paper", "ippo-separate"),
    ("saf-paper", "saf-paper-no-pool"),
    ("saf-no-pool", "saf-paper-no-pool"),
    ("mappo", "mappo-separate"),
)
_COLUMNS: Final = ["task", "level"]
#: Share of the treasures below which a setting says nothing about methods.
_FLOOR: Final = 0.01
#: Columns that tell trainings apart.
_RUN: Final = ["cell", "processor_seconds"]


class Claim(NamedTuple):
    """
    A claim of the paper and the test declared for it.

    :param text: the claim
    :param pair: methods, first minus second
    :param where: the settings in words
    :param rows: tests of these settings
    """

    text: str
    pair: tuple[str, str]
    where: str
    rows: pd.DataFrame


def read(name: str) -> Frames:
    """Return the raw data of an experiment."""
    return read_results(RAW, name)


def grid() -> Frames:
    """Return the raw data of the grid at levels of training, each cell once, in the order of tasks and levels."""
    frames = [read(name) for name in GRID]
    tests = pd.concat([frame.tests.query("train_level == level") for frame in frames])
    tests = _in_order(tests.drop_duplicates(["method", *_COLUMNS, "seed"]))
    curves = pd.concat([frame.curves for frame in frames]).drop_duplicates(["method", *_COLUMNS, "seed", "game_steps"])
    group = np.where(tests["heterogeneity"] == 1, "coordination", "joint")
    tests["group"] = np.where((tests["heterogeneity"] > 1) & (tests["coordination"] == 1), "heterogeneity", group)
    return Frames(tests, curves)


def _in_order(tests: pd.DataFrame) -> pd.DataFrame:
    """Return tests in the order of tasks and levels."""
    tasks = pd.Categorical(tests["task"], ["TeamSupport", "TeamTogether", "KeyForTreasure"])
    tests = tests.assign(task=tasks).sort_values(["task", "coordination", "heterogeneity"], kind="stable")
    return tests.astype({"task": str})


def other_levels() -> pd.DataFrame:
    """Return the tests at other levels than that of the training."""
    return pd.concat([read(name).tests.query("train_level != level and game_steps > 0") for name in OTHER_LEVELS])


def claims(tests: pd.DataFrame, unseen: pd.DataFrame, pixels: pd.DataFrame) -> list[Claim]:
    """Return the claims that these data can test."""
    general = 'SAF is better than {} "across different tasks and different heterogeneity and coordination levels"'
    everywhere = "all games"
    hidden, pixels = "TeamSupport, h = 5, zones as pixels", pixels.query("task == 'TeamSupport' and level == 'c1-h5'")
    anew = "TeamSupport and TeamTogether, h = 5, zones as pixels, fresh seeds"
    coordinated, zones = tests[tests["coordination"] > 1], tests[tests["heterogeneity"] > 1]
    return [
        Claim(general.format("MAPPO"), ("saf", "mappo"), everywhere, tests),
        Claim(general.format("IPPO"), ("saf", "ippo-separate"), everywhere, tests),
        Claim("high coordination favours SAF", ("saf", "mappo"), "c > 1", coordinated),
        Claim("high heterogeneity favours SAF", ("saf", "mappo"), "h > 1", zones),
        Claim("SAF is robust to unseen levels", ("saf", "mappo"), "levels not trained on", unseen),
        Claim("high heterogeneity favours SAF, zones as pixels", ("saf", "mappo"), hidden, pixels),
        Claim("the pool helps in heterogeneous maps", ("saf", "saf-no-pool"), hidden, pixels),
        Claim("the knowledge source helps", ("saf", "saf-no-ks"), hidden, pixels),
        Claim("high heterogeneity favours SAF, zones as pixels", ("saf", "mappo"), anew, read(FRESH).tests),
    ]


def shares(table: pd.DataFrame, first: str, second: str) -> pd.DataFrame:
    """
    Return the paired differences of two methods in percent of the largest return.

    :param table: table of tests
    :return: columns ``setting``, ``seed``, ``difference`` and ``variance`` (of the tests), one row per pair
    """
    ours, theirs = (table[table["method"] == method] for method in (first, second))
    pairs = ours.merge(theirs, on=["train_level", "task", "level", "seed"], suffixes=("", "_second"))
    scale = 100 / pd.to_numeric(pairs["max_return"]).to_numpy(dtype=np.float64)
    difference = (pairs["return_mean"] - pairs["return_mean_second"]).to_numpy(dtype=np.float64)
    setting = pairs["task"] + " " + pairs["train_level"] + " " + pairs["level"]
    variance = variance_of_tests(pairs) * scale**2
    return pd.DataFrame(
        {"setting": setting, "seed": pairs["seed"], "difference": difference * scale, "variance": variance}
    )


def pooled(pairs: pd.DataFrame) -> Difference | None:
    """
    Test the mean difference over settings: over those of their means if there are three or more, else over seeds.

    :param pairs: from :func:`shares`
    :return: in percent of the largest return; None without pairs
    """
    if pairs.empty:
        return None
    by = "setting" if pairs["setting"].nunique() >= FEWEST_SEEDS else "seed"
    groups = pairs.groupby(by)
    noise = float(np.sqrt((groups["variance"].mean() / groups.size()).mean()))
    return mean_difference(groups["difference"].mean().to_numpy(), noise, 100 * MARGIN)


def by_game(tests: pd.DataFrame, first: str, second: str) -> pd.DataFrame:
    """
    Return paired differences (:func:`shares`) whose ``setting`` is the game of the training.

    With c = 1 TeamTogether is TeamSupport in other colours. Tests of a team at several levels count once, too.
    """
    pairs = shares(tests, first, second)
    return pairs.assign(setting=pairs["setting"].str.rsplit(n=1).str[0].map(_game))


def _game(setting: str) -> str:
    return setting.replace("TeamTogether c1-", "TeamSupport c1-")


def difference(rows: pd.DataFrame, first: str, second: str) -> Difference | None:
    """Return the paired difference of two methods, over games if there are three or more, else over seeds."""
    return pooled(by_game(rows, first, second))


def table(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *body))


def show(estimate: Estimate) -> str:
    """Return a difference with its interval."""
    value, low, high = estimate
    return f"{value:+.1f}" if np.isnan(low) else f"{value:+.1f} [{low:.1f}, {high:.1f}]"


def answer(frames: Frames) -> str:
    """Return SAF's differences from the three other methods in one sentence each."""
    tests, lines = frames.tests, []
    for other in MAIN[1:]:
        pairs = by_game(tests, "saf", other)
        found = pooled(pairs)
        if found is not None:
            more, less = (pairs["difference"] > 0).sum(), (pairs["difference"] < 0).sum()
            lines.append(
                f"- SAF minus {WORDS[other]}: **{show(found.estimate)} % of the treasures** over {found.n} games: "
                f"{found.verdict}. SAF collected more in {more} of {len(pairs)} pairs of runs, less in {less}."
            )
    found = difference(_above_floor(tests), "saf", "mappo")
    means = shares(tests, "saf", "mappo").groupby("setting")["difference"].mean()
    if found is not None:
        lines.append(
            f"- Without the games where no method collects {100 * _FLOOR:.0f} %: SAF minus {WORDS['mappo']} "
            f"{show(found.estimate)} over {found.n}; {means.min():+.1f} to {means.max():+.1f} in single settings."
        )
    last = tests.assign(return_mean=tests["return_last"])
    by_last = [(other, difference(last, "saf", other)) for other in ("mappo", "ippo-separate")]
    values = (f"SAF minus {WORDS[other]} {show(found.estimate)}" for other, found in by_last if found is not None)
    lines.append(f"- Of last policies in the place of the best of 20: {', '.join(values)}.")
    early = {
        (_game(f"{task} {level}"), task, seed): _lead_at_equal_time(rows, ("mappo", "saf"))
        for (task, level, seed), rows in frames.curves.groupby([*_COLUMNS, "seed"])
        if {"saf", "mappo"} <= set(rows["method"])
    }
    lead = mean_over_seeds(pd.Series(early).groupby(level=0).mean().to_numpy())
    lines.append(
        f"- At equal processor time, when MAPPO's training ends, SAF's evaluations minus MAPPO's: {show(lead)}; SAF's "
        "learning rate has not reached 0 by then."
    )
    return "\n".join(lines)


def methods_table(tests: pd.DataFrame, unseen: pd.DataFrame) -> str:
    """Return a row for each method: interquartile means of the treasures' share by task and group, and its cost."""

    def scores(rows: pd.DataFrame) -> dict[str, Floats]:
        rows = rows[rows["method"].isin(MAIN)]
        return score_matrices(complete(rows.assign(stratum=keys_of(rows, "task", "train_level", "level"))), "stratum")

    columns = {
        "all": tests,
        **{task: tests[tests["task"] == task] for task in dict.fromkeys(tests["task"])},
        "h > 1": tests[tests["heterogeneity"] > 1],
        "other levels": unseen,
    }
    everywhere = scores(tests)
    means = {words: interquartile_means(scores(rows)) for words, rows in columns.items()}
    seconds = tests.groupby("method")["processor_seconds"].mean()
    body = []
    for method in MAIN:
        cells = ["{:.1f} [{:.1f}, {:.1f}]".format(*(100 * part for part in found[method])) for found in means.values()]
        better = probability_of_improvement(everywhere["saf"], everywhere[method])
        probability = "" if method == "saf" else "{:.2f} [{:.2f}, {:.2f}]".format(*better)
        body.append([WORDS[method], *cells, probability, f"{seconds[method]:.0f}"])
    return table(["method", *columns, "SAF is better", "seconds"], body)


def claims_table(found: Sequence[Claim]) -> str:
    """Return a row for each claim with enough runs, with p values corrected for their number (Holm)."""
    tested = [(claim, difference(claim.rows, *claim.pair)) for claim in found]
    shown = [(claim, test) for claim, test in tested if test is not None and test.n >= FEWEST_SEEDS]
    corrected = holm([test.p for _, test in shown])
    body = []
    for (claim, test), p in zip(shown, corrected, strict=True):
        first, second = (WORDS[method] for method in claim.pair)
        supported = p < 0.05 and test.estimate.value > 0
        verdict = (
            "supported" if supported else "**not supported**" + (", equivalent" if test.p_equivalent < 0.05 else "")
        )
        where = f"{first} minus {second}, {claim.where}, n = {test.n}"
        body.append([claim.text, where, show(test.estimate), f"{p:.2g}", verdict])
    return table(["the paper's claim", "test, % of the treasures", "effect", "p (Holm)", ""], body)


def losses(tests: pd.DataFrame, scripted: pd.DataFrame) -> str:
    """Return the share of the treasures of each method and script at c = 1, 2, 3 (h = 1), by task."""
    words, columns = {**{method: WORDS[method] for method in MAIN}, **SCRIPTED}, ["task", "level", "method"]
    played = pd.concat([tests, scripted.rename(columns={"team": "method"}).assign(max_return=100)])
    share = (100 * played["return_mean"] / played["max_return"]).groupby([played[name] for name in columns])
    levels, means, body = [f"c{c}-h1" for c in (1, 2, 3)], share.mean(), []
    for task in dict.fromkeys(tests["task"]):
        rows = [[means.get((task, level, method)) for level in levels] for method in words]
        body.append([task, *(", ".join("–" if mean is None else f"{mean:.0f}" for mean in row) for row in rows)])
    return table(["task", *words.values()], body)


def settings_table(tests: pd.DataFrame, of: Sequence[str] = MAIN) -> str:
    """Return the methods' mean returns at each level of training and test, with the smallest number of seeds."""
    body = []
    columns = ["task", "train_coordination", "train_heterogeneity", "coordination", "heterogeneity"]
    methods = [method for method in (RANDOM, *of) if (tests["method"] == method).any()]
    for (task, c, h, test_c, test_h), rows in tests.groupby(columns, sort=False):
        tested = "" if (c, h) == (test_c, test_h) else f", tested at c = {test_c}, h = {test_h}"
        means, trained = rows.groupby("method")["return_mean"].mean(), rows[rows["method"].isin(of)]
        cells = [f"{means[method]:.1f}" if method in means else "" for method in methods]
        n_seeds = trained.groupby("method")["seed"].nunique().min()
        body.append([f"{task}, c = {c}, h = {h}{tested}", *cells, str(n_seeds)])
    return table(["setting", *(WORDS[method] for method in methods), "seeds"], body)


def other_table(names: Iterable[str]) -> str:
    """Return what each method collects in experiments with settings of their own."""
    body = []
    for name in names:
        trained = read(name).tests.query("game_steps > 0")
        for (task, level), here in trained.groupby(_COLUMNS, sort=False):
            scores = here.groupby("method", sort=False)["score"]
            text = "; ".join(f"{WORDS.get(str(name), name)} {100 * of.mean():.1f} ({len(of)})" for name, of in scores)
            body.append([name, f"{task}, {level}", text])
    return table(["experiment", "setting", "% of the treasures (seeds)"], body)


def parts_table(tests: pd.DataFrame) -> str:
    """Return what SAF's parts and shared networks are worth in the games where some method collects anything."""
    body = []
    for first, second in PAIRS:
        pairs = by_game(_above_floor(tests), first, second)
        found = pooled(pairs)
        if found is not None:
            games = pairs.groupby("setting")["difference"].mean()
            by_task = games.groupby(games.index.str.split().str[0]).mean()
            cells = (f"{by_task[task]:+.1f}" if task in by_task else "" for task in dict.fromkeys(tests["task"]))
            body.append([WORDS[first], WORDS[second], show(found.estimate), str(found.n), *cells])
    return table(["", "minus", "all games", "games", *dict.fromkeys(tests["task"])], body)


def _above_floor(tests: pd.DataFrame) -> pd.DataFrame:
    """Return the tests of the settings where some method of the grid collects anything."""
    return tests[tests.groupby(_COLUMNS)["score"].transform("max") >= _FLOOR]


def factorial_table(names: Iterable[str]) -> str:
    """Return the mean return of each actor with each critic, and what the critics explain of their targets."""
    actors, critics = ("own", "shared", "pool"), ("own", "team", "mean", "source")
    body = []
    for name in names:
        means = read(name).tests.groupby("method")["return_mean"].mean()
        looks = pd.read_csv(RAW / name / "diagnosis.csv")
        explained = looks["critic/explained_variance_of_target"].groupby(looks["method"].str.rsplit("-").str[-1]).mean()
        for actor in actors:
            methods = [f"actor-{actor}-critic-{critic}" for critic in critics]
            cells = [f"{means[method]:.1f}" if method in means else "" for method in methods]
            body.append([name, WORDS[methods[0]].split(", ")[0], *cells])
        body.append([name, "explained variance", *(f"{explained[critic]:.2f}" for critic in critics)])
    heads = [WORDS[f"actor-own-critic-{critic}"].split(", ")[1] for critic in critics]
    return table(["experiment", "actor", *(f"critic: {head}" for head in heads)], body)


def elsewhere(trainings: pd.DataFrame, here: pd.DataFrame) -> str:
    """
    Return the returns of trainings on other processors, and how far those of the same seeds were from them here.

    :param trainings: ``block``, ``setting``, ``method``, ``seed``, ``return``, and processor ``on``
    :param here: tests at the levels of the training, with ``block``
    """
    keys = ["block", "setting", "method", "seed"]
    setting = here["task"] + ", c=" + here["coordination"].astype(str) + ", h=" + here["heterogeneity"].astype(str)
    trained = trainings[trainings["method"] != RANDOM].merge(here.assign(setting=setting), "left", keys)
    body = []
    for (block, setting), rows in trained[trained["return_mean"].isna()].groupby(keys[:2], sort=False):
        by_method = rows.groupby("method", sort=False)["return"]
        texts = [f"{WORDS[method]} {', '.join(f'{value:.1f}' for value in values)}" for method, values in by_method]
        body.append([block, setting, rows["on"].iloc[0], "; ".join(texts)])
    both = trained.dropna(subset="return_mean")
    apart = both["return"] - both["return_mean"]
    alike = here[here["task"].isin(both["task"]) & (here["block"] != MEMORY) & (here["method"] != RANDOM)]
    seeds = alike.groupby(["block", *_COLUMNS, "method"])["return_mean"]
    variances = seeds.var()[seeds.size() >= 5]
    limit = 2 * (2 * variances.mean()) ** 0.5
    blocks = ", ".join(sorted(set(both["block"])))
    return (
        table(["experiment", "setting", "processor", "returns of 100"], body)
        + f"\n\n{len(both)} more ({blocks}) have the seeds of trainings in the tables: their returns are "
        f"{apart.mean():+.1f} on average from those, {apart.min():+.1f} to {apart.max():+.1f}. Twice the "
        f"standard deviation of a difference of two seeds is {limit:.1f} ({len(variances)} settings and methods with "
        f"five seeds or more, {', '.join(sorted(set(alike['task'])))}); {(apart.abs() <= limit).sum()} of the "
        f"{len(both)} are within it."
    )


def memory_table(frames: Frames, remembering: Frames) -> str:
    """Return each method without and with a GRU in the settings that both have, paired by seed and test games."""
    body = []
    tests = pd.concat([frames.tests, remembering.tests.query("game_steps > 0")])
    curves = pd.concat([frames.curves, remembering.curves])
    for task, level in dict.fromkeys(keys_of(remembering.tests.query("game_steps > 0"), *_COLUMNS)):
        here, evaluations = (rows[(rows["task"] == task) & (rows["level"] == level)] for rows in (tests, curves))
        for method in ("mappo", "saf", "ippo"):
            pair = (method, f"{method}-gru")
            found = difference(here, *reversed(pair))
            if found is None:
                continue
            seeds = set.intersection(*(set(here.loc[here["method"] == one, "seed"]) for one in pair))
            rows = here[here["seed"].isin(seeds)].groupby("method")
            means, seconds = rows["return_mean"].mean(), rows["processor_seconds"].mean()
            early = [_lead_at_equal_time(evaluations[evaluations["seed"] == seed], pair) for seed in sorted(seeds)]
            cells = [f"{means[one]:.1f}" for one in pair] + [show(found.estimate), show(mean_over_seeds(early))]
            spent = "; ".join(f"{seconds[one]:.0f}" for one in pair)
            body.append([f"{task}, {level}", WORDS[method], str(len(seeds)), *cells, spent])
    head = ["setting", "method", "seeds", "without", "with a GRU", "difference, % of the treasures"]
    return table([*head, "at equal processor time", "processor seconds"], body)


def _lead_at_equal_time(curves: pd.DataFrame, pair: tuple[str, str]) -> float:
    """Return by how much the second method's evaluations are above the first's when the first one's training ends."""
    first, second = (curves[curves["method"] == method].sort_values("processor_seconds") for method in pair)
    end = first.iloc[-1]
    return float(np.interp(end["processor_seconds"], second["processor_seconds"], second["score"]) - end["score"])


def costs(tests: pd.DataFrame) -> str:
    """Return processor hours of training and tests, commits, and processors of these tests."""
    hours = (tests.drop_duplicates(_RUN)["processor_seconds"].sum() / 3600, tests["wall_seconds_test"].sum() / 3600)
    commits, processors = (", ".join(sorted(set(tests[column]))) for column in ("commit", "processor"))
    return f"{hours[0]:.1f} core-hours of training, {hours[1]:.1f} of tests, commit {commits}, {processors}."


def blocks_table(tests: pd.DataFrame) -> str:
    """Return trainings and processor hours of each block of runs."""
    body = []
    runs = tests.drop_duplicates(_RUN)
    for name, here in tests.groupby("block", sort=False):
        trained = runs[(runs["block"] == name) & (runs["game_steps"] > 0)]
        hours = trained["processor_seconds"].sum() / 3600, here["wall_seconds_test"].sum() / 3600
        body.append([str(name), str(len(trained)), *(f"{spent:.1f}" for spent in hours)])
    return table(["block", "trainings", "core-hours of training", "of tests"], body)


def forest(tests: pd.DataFrame) -> pd.DataFrame:
    """Return SAF minus MAPPO and minus the paper's IPPO in each setting, and pooled in each group."""
    rows = []
    for group, of_group in tests.groupby("group", sort=False):
        panel = "coordination" if group == "coordination" else "heterogeneity, joint"
        settings = of_group.groupby(["task", "coordination", "heterogeneity"], sort=False)
        named = [(f"{task}, c = {c}, h = {h}", here) for (task, c, h), here in settings]
        for label, here in [*named, (f"{group}, together", of_group)]:
            for other in MAIN[1:3]:
                found = difference(here, "saf", other)
                if found is not None:
                    rows.append((panel, label, other, *found.estimate.drawn(found.n), here is of_group))
    return pd.DataFrame(rows, columns=["panel", "level", "method", "value", "low", "high", "pooled"])


def curves(frames: Frames) -> pd.DataFrame:
    """Return the evaluations of two settings, and of longer trainings."""
    parts = [
        (frames, "TeamSupport", "c2-h1", "TeamSupport, c = 2"),
        (frames, "TeamSupport", "c1-h5", "TeamSupport, h = 5"),
        (read(LENGTH), "TeamSupport", "c2-h1", "TeamSupport, c = 2, the paper's length"),
    ]
    shown = []
    for source, task, level, name in parts:
        here = source.curves[source.curves["method"].isin(MAIN)]
        shown.append(here[(here["task"] == task) & (here["level"] == level)].assign(panel=name))
    return pd.concat(shown)


def fill(text: str, blocks: dict[str, str]) -> str:
    """Return a page with the blocks between its marks."""

    def block(mark: re.Match[str]) -> str:
        if mark["name"] not in blocks:
            raise ValueError(f"expected marks of {', '.join(blocks)}, got <!-- {mark['name']} -->")
        return f"<!-- {mark['name']} -->\n\n{blocks[mark['name']]}\n\n<!-- end -->"

    return re.sub(r"<!-- (?P<name>\w+) -->.*?<!-- end -->", block, text, flags=re.DOTALL)


def pages() -> dict[Path, str]:
    """Return the pages with their blocks made of the raw data."""
    names = sorted(path.parent.name for path in RAW.glob(f"*/{RUNS}"))
    everything = pd.concat([read(name).tests.assign(block=name) for name in names])
    everything = everything.drop_duplicates([*_RUN, "level"])
    factorial = [name for name in names if name.startswith(FACTORIAL)]
    others = [name for name in names if name not in (*GRID, MEMORY, PARTS, OTHER_LEVELS_PARTS, *factorial)]
    frames = grid()
    tests = frames.tests
    unseen = other_levels()
    parts = _in_order(read(PARTS).tests.query("game_steps > 0"))
    pixels = pd.concat([read(name).tests for name in PIXELS])
    blocks = {
        "answer": answer(frames),
        "methods": methods_table(tests, unseen),
        "claims": claims_table(claims(tests, unseen, pixels)),
        "memory": memory_table(frames, read(MEMORY)),
        "losses": losses(tests, pd.read_csv(RAW / "scripted.csv")),
        "settings": settings_table(tests),
        "unseen": settings_table(unseen),
        "unseen_parts": settings_table(
            read(OTHER_LEVELS_PARTS).tests.query("game_steps > 0"), ("saf", "saf-no-pool", "saf-paper-no-pool")
        ),
        "parts": parts_table(pd.concat([tests, parts])),
        "parts_settings": settings_table(parts, list(dict.fromkeys(method for pair in PAIRS for method in pair))),
        "others": other_table(others),
        "factorial": factorial_table(factorial),
        "elsewhere": elsewhere(pd.read_csv(RAW / "other_processor.csv"), everything.query("level == train_level")),
        "costs": costs(everything),
        "blocks": blocks_table(everything),
    }
    return {page: fill(page.read_text(encoding="utf-8"), blocks) for page in PAGES}


def add(name: str, folder: Path, raw: Path = RAW) -> None:
    """Add the finished cells of an experiment, ``RESULTS/EXPERIMENT``, to the raw data, in the place of older ones."""

    def cells(frame: pd.DataFrame) -> pd.Series:
        names = ["method", *(["train_level"] if "train_level" in frame else []), *_COLUMNS, "seed"]
        return frame[names].astype(str).agg("/".join, axis=1)

    tests, together = read_results(folder.parent, folder.name)
    if (raw / name).is_dir():
        kept = read_results(raw, name)
        tests = pd.concat([kept.tests[~cells(kept.tests).isin(cells(tests))], tests])
        together = pd.concat([kept.curves[~cells(kept.curves).isin(cells(together))], together])
    (raw / name).mkdir(parents=True, exist_ok=True)
    for file, frame in ((RUNS, tests), (CURVES, together)):
        write_text(raw / name / file, frame.to_csv(index=False, lineterminator="\n"))
    suite = tests["task"].iloc[0].partition("/")[0] if raw != RAW else "hecogrid"
    write_text(raw / name / "marl_eval.json", json.dumps(marl_eval(Frames(tests, together), suite)))


def main() -> None:
    """Add data and write pages and figures."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper", description=(__doc__ or "").split("::")[0])
    parser.add_argument(
        "--add", nargs=2, action="append", default=[], metavar=("NAME", "FOLDER"), help="finished cells"
    )
    for name, folder in parser.parse_args().add:
        add(name, Path(folder))
    for page, text in pages().items():
        write_text(page, text)
    frames, band = grid(), 100 * MARGIN
    write_text(RAW / "marl_eval.json", json.dumps(marl_eval(frames, "hecogrid")))
    figure = draw_differences(
        forest(frames.tests), panel="panel", x_label="SAF minus other, % of the treasures", names=WORDS, band=band
    )
    figure.savefig(RAW / "forest.png", dpi=120)
    draw_curves(curves(frames), panel="panel", names=WORDS).savefig(RAW / "curves.png", dpi=120)


if __name__ == "__main__":
    main()
