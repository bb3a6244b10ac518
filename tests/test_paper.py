"""The reproduction: its measures, its verdicts, and the whole of it end to end."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from misstep.errors import MisstepError
from misstep.paper import claims, figures
from misstep.paper.claims import Sample, judge_all
from misstep.paper.costs import HORIZONS, horizon_costs
from misstep.paper.experiments import VARIANTS, demonstrations_of, run_cell
from misstep.paper.measures import CellMeasures, measure
from misstep.paper.modes import action_grid, count_modes
from misstep.paper.printed import TABLE_1, TABLE_2
from misstep.paper.reproduction import reproduce, resume
from misstep.paper.synthetic import ANGLES, measure_synthetic, run_synthetic
from misstep.paper.tables import _percentiles

SMALL = ["--seeds", "1", "--quick"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """One whole reproduction, small."""
    out = tmp_path_factory.mktemp("paper") / "out"
    reproduce(out, seeds=1, quick=True, workers=2)
    return out


def test_cost_is_the_mean_absolute_angle_in_degrees():
    demonstrations = demonstrations_of("A", seed=3, index=0, n=2)
    costs = horizon_costs(demonstrations)
    for row, trajectory in zip(costs, demonstrations, strict=True):
        angles = np.degrees(np.abs(trajectory.column("theta")[1:]))
        for value, horizon in zip(row, HORIZONS, strict=True):
            assert value == pytest.approx(angles[: round(horizon * 20)].mean(), rel=1e-12)


def test_demonstrations_all_fail_and_cost_about_what_table_1_says():
    costs = horizon_costs(demonstrations_of("A", seed=0, index=0, n=40))
    low, high = np.percentile(costs, [1, 99], axis=0)
    inside = (low <= TABLE_1) & (high >= TABLE_1)
    assert inside.sum() >= 10  # of the twelve
    assert np.all(costs[:, 0] > 30.0)


def test_every_variant_of_a_seed_sees_the_same_demonstrations():
    first, second = (demonstrations_of("A", seed=1, index=2) for _ in range(2))
    other = demonstrations_of("A", seed=1, index=3)
    assert np.array_equal(first[0].observations, second[0].observations)
    assert not np.array_equal(first[0].observations[:50], other[0].observations[:50])


def test_synthetic_donut_is_a_bump_where_they_agree_and_hollow_where_they_do_not():
    measures = [measure_synthetic(run_synthetic(seed)) for seed in range(8)]
    assert sum(m.modes[0] == 1 for m in measures) >= 7
    assert all(m.modes[1] >= 2 for m in measures)
    assert all(m.reached[1] >= 2 for m in measures)
    assert all(m.exploration[0] < 0.2 < m.exploration[1] for m in measures)


def test_synthetic_spread_is_that_of_the_two_demonstrators():
    run = run_synthetic(0)
    forces = np.array([t.actions[:, 0] for t in run.demonstrations])
    near = np.abs(np.abs(ANGLES) - 90.0) < 30.0
    # Signs of the angle differ on the two sides, so the second moment is compared.
    assert measure_synthetic(run).spread[1] == pytest.approx(forces[:, near].std(), rel=0.35)


def test_count_modes_agrees_with_the_ends_of_many_climbs():
    donut = run_synthetic(0).policies[0].donut_at([90.0])
    starts = action_grid(donut.conditional, points=60)
    ends = np.sort([donut.mode([start])[0] for start in starts])
    assert count_modes(donut) == 1 + int(np.sum(np.diff(ends) > 0.05))


def test_measures_survive_json(tmp_path):
    run = run_cell(tmp_path / "run", VARIANTS["mean"], seed=0, index=0)
    measures = measure(run)
    back = CellMeasures.from_json(json.loads(json.dumps(measures.to_json())))
    for ours, theirs in zip(measures, back, strict=True):
        assert np.array_equal(ours, theirs)


def test_an_interrupted_cell_goes_on_to_the_same_end(tmp_path):
    variant = VARIANTS["without-reward"]
    whole_run = run_cell(tmp_path / "a", variant, seed=0, index=0)

    class StopError(Exception):
        pass

    def stop(run):
        if len(run.trials) == 4:
            raise StopError

    with pytest.raises(StopError):
        run_cell(tmp_path / "b", variant, seed=0, index=0, on_trial=stop)
    resumed = run_cell(tmp_path / "b", variant, seed=0, index=0)
    for ours, theirs in zip(whole_run.trials, resumed.trials, strict=True):
        assert np.array_equal(ours.observations, theirs.observations)
        assert np.array_equal(ours.actions, theirs.actions)


def _samples(costs: float, n: int) -> list[Sample]:
    """Samples whose explorations cost `costs` times what the demonstrations do."""
    eleven = np.ones(11)
    cell = CellMeasures(
        demonstration_costs=np.full((4, 3), 50.0) + np.arange(4)[:, None],
        exploration_costs=np.full((11, 3), 50.0 * costs) + np.arange(11)[:, None],
        successes=0,
        components=3 * eleven,
        action_spread=eleven,
        disagreement=eleven,
        narrowest=0.1 * eleven,
        exploration=eleven,
        jumps=eleven,
        above=eleven,
        several_modes=eleven,
        modes_differ=eleven,
    )
    return [Sample({"without-reward": cell}, None) for _ in range(n)]


def _verdict(samples) -> str:
    found = [c for c in judge_all(samples) if "perform very poorly" in c.sentence]
    assert len(found) == 1
    return found[0].verdict


def test_verdicts_follow_the_interval():
    assert _verdict({"A": _samples(2.0, 30)}) == "holds"
    assert _verdict({"A": _samples(0.5, 30)}) == "does not hold"
    assert _verdict({"A": _samples(2.0, 1)}) == "undecided"
    assert _verdict({"A": _samples(2.0, 15) + _samples(0.5, 15)}) == "undecided"
    mixed = {"A": _samples(2.0, 30), "B": _samples(0.5, 30)}
    assert _verdict(mixed) == "depends on the physics"


def test_claims_that_quote_the_paper_quote_its_tables():
    assert TABLE_2.std(axis=0, ddof=1)[2] / TABLE_1.std(axis=0, ddof=1)[2] == pytest.approx(
        4.2, abs=0.05
    )
    assert TABLE_2[:, 0].mean() / TABLE_1[:, 0].mean() == pytest.approx(1.58, abs=0.005)
    assert TABLE_1[:, 1].min() / TABLE_2[:, 1].min() == pytest.approx(0.99, abs=0.005)
    assert TABLE_1[:, 2].min() / TABLE_2[:, 2].min() == pytest.approx(2.34, abs=0.005)


def test_every_claim_has_the_variants_it_needs():
    for test in claims.TESTS:
        for name in test.needs:
            assert name in VARIANTS


def test_percentiles_by_brute_force():
    rng = np.random.default_rng(0)
    ours, paper = rng.normal(size=(200, 4, 3)), rng.normal(size=(4, 3))
    ranks = _percentiles(paper, ours)
    for i in range(4):
        for j in range(3):
            assert ranks[i][j] == round(100 * sum(v < paper[i, j] for v in ours[:, i, j]) / 200)


def test_the_report_holds_every_figure_and_reaches_outside_for_nothing(whole):
    page = (whole / "report.html").read_text(encoding="utf-8")
    for number in range(1, 26):
        assert f"Figure {number}.</b>" in page
    assert len(re.findall(r'src="data:image/png;base64', page)) >= 28
    assert len(re.findall(r'src="data:video/mp4;base64', page)) == 7
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    for name in figures.FIGURES:
        assert (whole / "figures" / f"{name}.png").stat().st_size > 5_000
        assert (whole / "figures" / f"{name}.pdf").stat().st_size > 2_000


def test_tables_json_has_what_is_promised(whole):
    document = json.loads((whole / "tables.json").read_text())
    asked = {"seeds": 1, "seed": 0, "quick": True, "physics": "mujoco"}
    assert document["parameters"] == asked
    assert np.array(document["tables"]["I"]["first_seed"]).shape == (4, 3)
    assert np.array(document["tables"]["II"]["mean"]).shape == (11, 3)
    assert np.array(document["tables"]["II"]["percentile_of_paper"]).shape == (11, 3)
    for claim in document["claims"]:
        assert {"sentence", "measured", "seeds", "verdict"} <= set(claim)


def test_killed_and_resumed_gives_the_same_tables(whole, tmp_path):
    out = tmp_path / "out"
    code = "from misstep.cli import main; main()"
    command = [sys.executable, "-c", code, "reproduce", *SMALL, "--out", str(out), "--workers", "1"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + 120
    while not list(out.glob("cells/*/000.json")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not (out / "tables.json").exists()
    resume(out, workers=2)
    assert (out / "tables.json").read_bytes() == (whole / "tables.json").read_bytes()


def test_a_folder_with_something_else_is_left_alone(tmp_path, whole):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(MisstepError, match="not empty"):
        reproduce(tmp_path, seeds=1)
    assert os.listdir(tmp_path) == ["mine.txt"]
    with pytest.raises(MisstepError, match="seeds 1, not 2"):
        reproduce(whole, seeds=2, quick=True)
    with pytest.raises(MisstepError, match="no physics bullet: there are mujoco, gazebo"):
        reproduce(tmp_path / "new", physics="bullet")
    with pytest.raises(MisstepError, match="seeds must be at least 1"):
        reproduce(tmp_path / "new", seeds=0)
    assert not Path(tmp_path / "new").exists()
