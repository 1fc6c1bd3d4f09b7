"""Our means beside those that the paper printed: its tables 1 to 4, the means, and the quadrotor's.

    python examples/paper/published_tables.py outputs/study/ugv_paper

Writes CSV and LaTeX, and prints Markdown. Give it the folder of
study=quadrotor_paper, too, for the quadrotor's. The paper gave each mission
5000 steps, and one that ran out counts 4999, the number of its last step. Steps of ours compare
with these only under the same budget: the tables say where it differs.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import pandas as pd

from afm_rl.report import read_runs
from afm_rl.report.runs import scenario_names
from afm_rl.report.statistics import estimate, pair
from afm_rl.report.tables import Table, interval_text, markdown
from afm_rl.storage.files import write_whole
from afm_rl.storage.measures import number

LAST = 4999  # step of a published mission that ran out
LABELS = {  # ours: the paper's
    "afm_paper": "afm",
    "afm_paper_code": "afm",
    "afm_dr": "afm_dr",
    "online_pe": "online_pe",
    "frozen_pe": "frozen_pe",
    "stream_x_pe": "stream_x_pe",
    "physics": "physics",
}
MEASURES = {"success": "success_rate", "steps": "steps"}  # the paper's: our column
CODED = "afm_paper_code"
PRINTED = {  # number of a table: its track, and its methods after AFM
    1: ("ethz_1", ["stream_x_pe", "physics"]),
    2: ("ethz_2", ["stream_x_pe", "physics"]),
    3: ("ethz_1", ["frozen_pe", "online_pe"]),
    4: ("ethz_2", ["frozen_pe", "online_pe"]),
}
HEADS = {
    "afm_paper": "AFM, gate as written",
    CODED: "AFM, gate as coded",
    "afm_dr": "AFM+DR",
    "online_pe": "Online PE",
    "frozen_pe": "PE",
    "stream_x_pe": "stream-x PE",
    "physics": "Physics",
}
TEXT = pd.DataFrame([{"method": "afm_dr", "success_mean": 0.836, "steps_mean": 3131.2}])
FLIGHTS = ("physics", "online_knode", "afm_online_knode", "afm_physics", "oracle")
JIAHAO = {  # Online-KNODE-MPC, Jiahao et al. 2022, table 1, circles of 2 m: m/s: m²
    "physics": {0.8: 0.0904, 1.0: 0.1280, 1.2: 0.1705},
    "online_knode": {0.8: 0.0660, 1.0: 0.1113, 1.2: 0.1678},
}


def published() -> pd.DataFrame:
    """Return the published means and standard deviations, with our scenarios."""
    figures = pd.read_csv(Path(__file__).with_name("published.csv"))
    figures["track"] = "ethz_" + figures["track"].astype(str)
    named = figures[["method", "track", "v_gain", "omega_gain"]].assign(seed=0)
    return figures.assign(scenario=scenario_names(named))


def budget_note(missions: pd.DataFrame) -> str:
    """Say it where missions of ours had another budget."""
    other = sorted(set(missions.loc[~missions["finished"].astype(bool), "steps"]) - {LAST})
    if not other:
        return ""
    counted = " or ".join(map(str, other))
    return (
        f" Ours count {counted}: our budget was another one, so steps and success do not compare."
    )


def cells_table(number: int, ours: pd.DataFrame) -> Table:
    """Return one of the paper's tables: a row per regime, success / steps of each method."""
    track, others = PRINTED[number]
    figures = published()
    figures = figures[figures["track"] == track]
    own = ours.groupby(["scenario", "method"])[list(MEASURES.values())]
    own = own.agg(["mean", lambda values: values.std(ddof=0)])
    rows, numbers = [], []
    for scenario, group in figures.groupby("scenario", sort=False):
        printed = group.set_index("method")
        first = group.iloc[0]
        row = {name: f"{first[name]:g}" for name in ("v_gain", "omega_gain")}
        for method in ("afm_paper", CODED, *others):
            numbers.append({"method": method, **printed.loc[LABELS[method]], "scenario": scenario})
            row[HEADS[method]] = "-"
            if (scenario, method) in own.index:
                values = own.loc[(scenario, method)].to_list()
                names = [f"ours_{name}" for name in list(figures)[-5:-1]]
                numbers[-1] |= dict(zip(names, values, strict=True))
                row[HEADS[method]] = _both(*values)
            if method != "afm_paper":
                head = f"{'AFM' if method == CODED else HEADS[method]}, published"
                row[head] = _both(*printed.loc[LABELS[method]].iloc[-5:-1])
        rows.append(row)
    title = f"Table {number} of the paper: success / steps on {track}"
    note = (
        f"Mean ± standard deviation over the seeds of a regime ({_seeds(ours)}; published: five). "
        "The deviation divides by n, which is what the published ones fit. A dash: not run."
        + budget_note(ours)
    )
    return Table(f"paper_table_{number}", title, note, pd.DataFrame(numbers), pd.DataFrame(rows))


def _both(success: float, success_std: float, steps: float, steps_std: float) -> str:
    return f"{success:.2f} ± {success_std:.2f} / {steps:.0f} ± {steps_std:.0f}"


def _seeds(missions: pd.DataFrame) -> str:
    """Say how many seeds there are of a scenario: fewer where a study is under way."""
    counts = missions.groupby(["method", "scenario"])["seed"].nunique()
    least, most = counts.min(), counts.max()
    return f"ours: {most}" if least == most else f"ours: {least} to {most}"


def means_table(ours: pd.DataFrame) -> Table:
    """Return the means over all scenarios, and the paired differences from Online PE."""
    figures = published().rename(columns={"method": "printed"})
    rows, numbers = [], []
    for method, name in LABELS.items():
        own = ours[ours["method"] == method]
        same = figures[figures["scenario"].isin(own["scenario"])] if len(own) else figures
        whole = own["scenario"].nunique() in (0, figures["scenario"].nunique())
        printed = same[same["printed"] == name] if name != "afm_dr" else TEXT.head(int(whole))
        figure = {"method": method, "missions": len(own)}
        figure |= printed[["success_mean", "steps_mean"]].mean()
        row = {"method": HEADS[method], "missions": str(len(own))}
        pairs = pair(ours, method, "online_pe")
        for head, column in MEASURES.items():
            digits = 3 if head == "success" else 0
            row[f"{head}, ours"] = row[f"{head} - Online PE"] = "-"
            if len(own):
                figure |= estimate(column, own[column], own["scenario"])
                row[f"{head}, ours"] = interval_text(figure, column, digits)
            if len(pairs) and method != "online_pe":
                apart = pairs[column] - pairs[f"{column}_other"]
                figure |= estimate(f"{column}_apart", apart, pairs["scenario"])
                row[f"{head} - Online PE"] = interval_text(
                    figure, f"{column}_apart", digits, sign="+"
                )
            row[f"{head}, published"] = number(figure[f"{head}_mean"], digits)
        order = ["ours", "published", "- Online PE"]
        heads = [
            f"{head} {end}" if end[0] == "-" else f"{head}, {end}"
            for head in MEASURES
            for end in order
        ]
        rows.append({name: row[name] for name in ("method", "missions", *heads)})
        numbers.append(figure)
    note = (
        "Means over the scenarios that were run (all: 22), with 95 % stratified bootstrap "
        "intervals "
        f"(strata: scenarios; {_seeds(ours)} seeds of a scenario); published: means of the printed "
        "tables over the same scenarios, of AFM+DR that of the text, over all. Differences from "
        "Online PE are paired by scenario and seed." + budget_note(ours)
    )
    title = "All scenarios: success and steps"
    return Table("paper_means", title, note, pd.DataFrame(numbers), pd.DataFrame(rows))


def tables(missions: pd.DataFrame) -> list[Table]:
    """Return the means and the paper's four tables; none without missions of a published one."""
    ours = missions[missions["method"].isin(list(LABELS))]
    ours = ours[ours["scenario"].isin(published()["scenario"])]
    if ours.empty:
        return []
    found = [means_table(ours)]
    for place, (track, _) in PRINTED.items():
        there = ours[ours["track"] == track]
        if len(there):
            found.append(cells_table(place, there))
    return found


def flights_table(missions: pd.DataFrame) -> Table:
    """Return the quadrotor's error at each speed, and its mean change over Online-KNODE."""
    speeds = missions["track"].str.extract(r"_([\d.]+)mps", expand=False).astype(float)
    ours = missions.assign(speed=speeds)
    rows, numbers = [], []
    for method in FLIGHTS:
        own = ours[ours["method"] == method]
        for name, values in (("ours", own), ("Jiahao et al.", JIAHAO.get(method, {}))):
            if not len(values):
                continue
            row = {"method": f"{method}, {name}"}
            for speed in sorted(ours["speed"].unique()):
                figure = {"method": method, "whose": name, "speed": speed}
                if isinstance(values, pd.DataFrame):
                    at = own[own["speed"] == speed]
                    figure |= estimate("mse", at["mse"], at["speed"])
                    row[f"{speed:g} m/s"] = interval_text(figure, "mse", 5)
                elif speed in values:
                    figure |= {"mse": values[speed]}
                    row[f"{speed:g} m/s"] = f"{values[speed]:.4f}"
                numbers.append(figure)
            if isinstance(values, pd.DataFrame) and method != "online_knode":
                pairs = pair(ours, method, "online_knode")
                if len(pairs):
                    share = 100 * (pairs["mse"] / pairs["mse_other"] - 1)
                    figure = estimate("share", share, pairs["scenario"])
                    row["mean change (%)"] = interval_text(figure, "share", 1, sign="+")
            rows.append(row)
    rows.append({"method": "AFM over Online-KNODE, the paper's text", "mean change (%)": "-6.6"})
    shown = pd.DataFrame(rows).fillna("")
    note = (
        "Mean squared error (m²) with the interval over seeds, and its mean relative change over "
        "Online-KNODE, paired by speed and seed. The paper prints a figure without numbers; the "
        "published rows are those of Jiahao et al. (2022)."
    )
    title = "The quadrotor, protocol A"
    return Table("paper_quadrotor", title, note, pd.DataFrame(numbers), shown)


def of_folders(folders: Sequence[Path]) -> Iterator[Table]:
    """Yield the tables of each kind of mission that there is."""
    kinds: dict[bool, list[Path]] = {False: [], True: []}
    for folder in folders:
        kinds["mse" in read_runs([folder]).missions].append(folder)
    for flies, some in kinds.items():
        if some:
            missions = read_runs(some).missions
            yield from [flights_table(missions)] if flies else tables(missions)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, help="results of runs or studies")
    parser.add_argument("--out", type=Path, help="where to (FOLDER/report/tables, of the first)")
    options = parser.parse_args()
    out = options.out or options.folders[0] / "report" / "tables"
    for each in of_folders(options.folders):
        write_whole(out / f"{each.name}.csv", each.to_csv().encode())
        write_whole(out / f"{each.name}.tex", each.to_latex().encode())
        print(markdown(each.title, each.shown), each.note, sep="\n\n")
