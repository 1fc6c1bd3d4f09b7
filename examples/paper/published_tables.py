"""Our means beside those that the paper printed: claims, means, tables 1 to 4, the quadrotor's.

    python examples/paper/published_tables.py outputs/study/ugv_paper

Writes CSV, and prints Markdown. Give it the folder of
study=quadrotor_paper, too, for the quadrotor's. The paper gave each mission
5000 steps, and one that ran out counts 4999, the number of its last step. Steps of ours compare
with these only under the same budget: the tables say where it differs.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import pandas as pd
from published_claims import AFM, LAST, claims_table, learning

from afm_rl.report import read_runs
from afm_rl.report.runs import Runs, scenario_names
from afm_rl.report.statistics import estimate, pair
from afm_rl.report.tables import Table, interval_text, markdown
from afm_rl.storage.files import write_whole
from afm_rl.storage.manifest import COMPUTE
from afm_rl.storage.measures import number

MEASURES = {"success": "success_rate", "steps": "steps"}  # the paper's: our column
HEADS = {
    "afm_paper": "AFM, gate as written",
    "afm_paper_code": "AFM, gate as coded",
    "afm_dr": "AFM+DR",
    "online_pe": "Online PE",
    "frozen_pe": "PE",
    "stream_x_pe": "stream-x PE",
    "physics": "Physics",
}
FORMS = {"afm_paper": "gate as written", "afm_paper_code": "gate as coded"}
LABELS = {name: name for name in HEADS} | dict.fromkeys(FORMS, AFM)  # ours: the paper's
TEXT = pd.DataFrame([{"method": "afm_dr", "success_mean": 0.836, "steps_mean": 3131.2}])
FLIGHTS = ("physics", "online_knode", "flow_as_written", "flow_as_coded", "afm_online_knode")
FLIGHTS += ("afm_physics", "oracle")
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
    """Return a note if our missions had another budget."""
    other = sorted(set(missions.loc[~missions["finished"].astype(bool), "steps"]) - {LAST})
    if not other:
        return ""
    counted = " or ".join(map(str, other))
    return (
        f" Ours count {counted}: our budget was another one, so steps and success do not compare."
    )


def cells_table(track: str, ours: pd.DataFrame) -> Table:
    """Return the paper's tables of a track: a row per regime, success/steps of each method."""
    means = ours.groupby(["scenario", "method"])[list(MEASURES.values())]
    means = means.agg(["mean", lambda values: values.std(ddof=0)])
    means.columns = [f"ours_{name}_{kind}" for name in MEASURES for kind in ("mean", "std")]
    labels = pd.DataFrame(LABELS.items(), columns=["method", "printed"])
    numbers = published().query("track == @track").rename(columns={"method": "printed"})
    numbers = numbers.merge(labels).merge(means, "left", on=["scenario", "method"])
    rows = []
    for gains, group in numbers.groupby(["v_gain", "omega_gain"], sort=False):
        row, methods = {"regime": "{:g}, {:g}".format(*gains)}, group.set_index("method")
        for method in (name for name in HEADS if name in methods.index):
            measured, printed = (_both(methods.loc[method], whose) for whose in ("ours_", ""))
            if method == "afm_paper":
                row[HEADS[method]] = measured
            else:
                row[f"{HEADS[method]} (published)"] = f"{measured} ({printed})"
        rows.append(row)
    title = f"The paper's tables of {track}: success/steps"
    note = (
        f"Means over the seeds of a regime ({_seeds(ours)}; published: five); standard deviations, "
        "divided by n as the published ones, are in the CSV file. A dash: not run."
        + budget_note(ours)
    )
    return Table(f"paper_{track}", title, note, numbers, pd.DataFrame(rows))


def _both(means: pd.Series, whose: str) -> str:
    success, steps = (means[f"{whose}{name}_mean"] for name in MEASURES)
    return "-" if pd.isna(success) else f"{success:.2f}/{steps:.0f}"


def _seeds(missions: pd.DataFrame) -> str:
    """Return the number of seeds of a scenario, which is smaller while a study runs."""
    counts = missions.groupby(["method", "scenario"])["seed"].nunique()
    least, most = counts.min(), counts.max()
    return f"ours: {most}" if least == most else f"ours: {least} to {most}"


def means_table(ours: pd.DataFrame) -> Table:
    """Return the means over all scenarios, and in how many of them time runs out."""
    figures = published().rename(columns={"method": "printed"})
    rows, numbers = [], []
    for method in (name for name in HEADS if name in set(ours["method"])):
        missions = ours[ours["method"] == method]
        printed = figures[figures["scenario"].isin(missions["scenario"])]
        complete = len(printed) == len(figures)
        printed = printed[printed["printed"] == LABELS[method]]
        printed = TEXT.head(int(complete)) if method == "afm_dr" else printed
        late = ~missions.groupby("scenario")["finished"].any()
        figure = {"method": method, "missions": len(missions), "late": int(late.sum())}
        figure |= printed[["success_mean", "steps_mean"]].mean()
        row = {"method": HEADS[method]}
        for head, column in MEASURES.items():
            digits = 3 if head == "success" else 0
            figure |= estimate(column, missions[column], missions["scenario"])
            row[f"{head}, ours"] = interval_text(figure, column, digits)
            row[f"{head}, published"] = number(figure[f"{head}_mean"], digits)
        row["out of time, ours"] = str(figure["late"])
        ended = (printed["steps_mean"] >= LAST).sum()
        row["out of time, published"] = str(ended) if method != "afm_dr" else "-"
        if "flow_error" in missions:
            figure["flow_error"] = missions["flow_error"].mean()
            row["error of the flow"] = number(figure["flow_error"], 3)
        rows.append(row)
        numbers.append(figure)
    note = (
        "Means over the scenarios that were run (all: 22), with 95 % stratified bootstrap "
        f"intervals (strata: scenarios; {_seeds(ours)} seeds of a scenario); published: means of "
        "the printed tables over the same scenarios, of AFM+DR that of the text, over all. Out of "
        "time: scenarios in which no seed reached every target. Error of the flow: of its action, "
        "root mean square, held out." + budget_note(ours)
    )
    title = "Means over all scenarios"
    return Table("paper_means", title, note, pd.DataFrame(numbers), pd.DataFrame(rows))


def tables(missions: pd.DataFrame) -> list[Table]:
    """Return claims, means and the paper's tables; none without missions of a published method."""
    ours = missions[missions["method"].isin(list(LABELS))]
    figures = published()
    ours = ours[ours["scenario"].isin(figures["scenario"])]
    if ours.empty:
        return []
    measured = ours.assign(success=ours["success_rate"], late=~ours["finished"].astype(bool))
    printed = figures.rename(columns={f"{name}_mean": name for name in MEASURES})
    printed = printed.assign(seed=0, late=printed["steps"] >= LAST)
    claims = claims_table(measured, printed, FORMS, budget_note(ours))
    cells = [cells_table(str(track), rows) for track, rows in ours.groupby("track")]
    return [claims, means_table(ours), *cells]


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


def with_learning(runs: Runs) -> pd.DataFrame:
    """Return the missions with what was learnt in each, and the flow's error where it is known."""
    steps = runs.steps(columns=["loss", "error", "regime_active"])
    missions = runs.missions.join(learning(steps), on="mission")
    errors: dict[str, float] = {}
    for file in filter(Path.is_file, (folder / COMPUTE for folder in runs.folders)):
        taken = pd.read_csv(file).set_index("method").reindex(columns=["flow_error"])
        errors |= taken["flow_error"].dropna()
    return missions.assign(flow_error=missions["method"].map(errors)) if errors else missions


def of_folders(folders: Sequence[Path]) -> Iterator[Table]:
    """Yield the tables of each kind of mission that there is."""
    kinds: dict[bool, list[Path]] = {False: [], True: []}
    for folder in folders:
        kinds["mse" in read_runs([folder]).missions].append(folder)
    for flies, some in kinds.items():
        if some:
            runs = read_runs(some)
            yield from [flights_table(runs.missions)] if flies else tables(with_learning(runs))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, help="results of runs or studies")
    parser.add_argument("--out", type=Path, help="where to (FOLDER/report/tables, of the first)")
    options = parser.parse_args()
    out = options.out or options.folders[0] / "report" / "tables"
    for each in of_folders(options.folders):
        write_whole(out / f"{each.name}.csv", each.to_csv().encode())
        print(markdown(each.title, each.shown), each.note, sep="\n\n")
