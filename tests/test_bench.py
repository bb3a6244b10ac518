import ast
import json
import os
import re
import signal
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from misstep.bench import hardware, peers, plan, results, run
from misstep.bench.contenders import ascent, criterion, misstep_itself, plain_numpy, scikit_learn
from misstep.bench.measuring import first_mode
from misstep.bench.peers import GMR, MISSTEP, PLAIN_NUMPY, PYPR, SCIKIT_LEARN
from misstep.bench.problems import draw_path, draw_samples, draw_start
from misstep.bench.results import Row
from misstep.bench.tables import number
from misstep.bench.worker import Worker
from misstep.cli import main
from misstep.mixture import GaussianMixture

TINY = replace(
    plan.QUICK,
    em_sizes=((600, 2),),
    scan_sizes=((600, 2),),
    threads=(1,),
    query_components=(4,),
    query_columns=(2,),
    em_iterations=3,
    scan_iterations=3,
    queries=60,
    slow_queries=10,
    slow_samples=1_000,
    mixtures={"misstep": 2, "scikit-learn": 1},
    growth={"n": (500, 1_000)},
    memory_size=(5_000, 3),
    most_components=3,
)


@pytest.fixture
def worker(tmp_path):
    def make(peer):
        return Worker(peer, Path(sys.executable), 1, tmp_path)

    return make


@pytest.fixture
def unreachable(monkeypatch):
    """Leave pip without any place to install from."""
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    for name in ("PIP_FIND_LINKS", "PIP_INDEX_URL", "PIP_EXTRA_INDEX_URL"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Return an environment for peers that holds none."""
    return tmp_path_factory.mktemp("environments") / "peers"


def copies(parts):
    return [part.copy() for part in parts]


# The contenders do the same work


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("d", [1, 2, 5])
def test_the_same_start_and_iterations_lead_every_contender_to_the_same_mixture(d):
    X = draw_samples(1_000, d)
    start = draw_start(X, 3)
    ours = misstep_itself.fit(X, *copies(start), 7)
    for library in (plain_numpy, scikit_learn):
        model = library.fit(X, *copies(start), 7)
        log_likelihood = library.log_likelihood(model, X)
        assert log_likelihood == pytest.approx(misstep_itself.log_likelihood(ours, X), rel=1e-10)
        pairs = zip(library.parameters(model), misstep_itself.parameters(ours), strict=True)
        for part, expected in pairs:
            np.testing.assert_allclose(part, expected, rtol=1e-7, atol=1e-9)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_sharing_the_work_of_a_scan_changes_no_result():
    X = draw_samples(1_000, 3)
    starts = [draw_start(X, K) for K in range(1, 5)]
    shared = misstep_itself.fit_all(X, [copies(start) for start in starts], 5)
    for start, (model, total) in zip(starts, shared, strict=True):
        alone = misstep_itself.fit(X, *copies(start), 5)
        assert total == pytest.approx(misstep_itself.log_likelihood(alone, X), rel=1e-12)
        assert total == pytest.approx(model.score(X) * len(X), rel=1e-9)


@pytest.mark.parametrize(("K", "d"), [(4, 2), (3, 5), (4, 14)])
def test_a_numerical_ascent_over_densities_ends_at_the_mode_of_the_compiled_one(K, d):
    path = draw_path(K, d, 40)
    n = path.states.shape[1]
    action = first_mode(path.mixture, path.states[0], path.scale)
    ours = misstep_itself.querier(path.mixture, n, path.scale, 2.0, 2.0)
    theirs = plain_numpy.querier(path.mixture, n, path.scale, 2.0, 2.0)
    for state in path.states:
        mode = ours(state, action)
        # Where a ridge is nearly level, as with two actions, both end before the very top.
        close = 0.01 * np.min(path.scale) / 0.3
        np.testing.assert_allclose(theirs(state, action), mode, atol=close)
        action = mode


def test_the_ascent_finds_the_top_of_a_hill_and_stays_there():
    top = np.array([1.0, -2.0])

    def density(points):
        return np.exp(-0.5 * ((points - top) ** 2).sum(axis=1))

    found = ascent.climb(density, np.array([-1.5, 1.0]), np.ones(2))
    np.testing.assert_allclose(found, top, atol=1e-6)
    np.testing.assert_allclose(ascent.climb(density, found, np.ones(2)), found, atol=1e-6)


def test_bic_is_scikit_learns_and_a_fit_without_a_likelihood_never_wins():
    from sklearn.mixture import GaussianMixture as Theirs

    X = draw_samples(500, 2)
    model = Theirs(3, random_state=0).fit(X)
    assert criterion.bic(model.score(X) * 500, 500, 3, 2) == pytest.approx(model.bic(X))
    assert criterion.least_bic(X, 3, lambda K: float("nan") if K == 3 else -1e6 / K) == 2


# Their processes


def test_a_contender_answers_with_its_times_and_its_mixture(worker):
    X = draw_samples(800, 2)
    weights, means, covariances = draw_start(X, 2)
    arrays = {"X": X, "weights": weights, "means": means, "covariances": covariances}
    with worker(SCIKIT_LEARN) as process:
        answer = process.ask("fit", arrays, 60, warm=800, iterations=5, repeats=2)
        assert 0 < len(answer["seconds"]) <= 2
        mixture = GaussianMixture.from_parameters(*map(np.array, answer["mixture"]))
        assert mixture.score(X) > GaussianMixture.from_parameters(*draw_start(X, 2)).score(X)
        refused = process.ask(
            "fit", arrays | {"weights": -weights}, 60, **{"warm": 800}, iterations=5
        )
        assert "Error" in refused["error"]
        assert process.ask("query", arrays, 60) == {"error": "not offered"}


def test_a_job_that_takes_too_long_is_given_up_and_the_next_one_finds_a_new_process(worker):
    X = draw_samples(100_000, 5)
    with worker(SCIKIT_LEARN) as process:
        slow = process.ask("scan", {"X": X}, 0.05, warm=100_000, most=10, seed=0, repeats=1)
        assert slow == {"error": "longer than 0 s"}
        assert process.ask("scan", {"X": X[:500]}, 60, warm=500, most=2, seed=0, repeats=1)["k"] > 0


def test_a_process_that_dies_is_told_and_replaced(worker):
    X = draw_samples(500, 2)
    job = {"warm": 500, "most": 2, "seed": 0, "repeats": 1}
    with worker(SCIKIT_LEARN) as process:
        first = process.ask("scan", {"X": X}, 60, **job)
        os.kill(process._running().pid, signal.SIGKILL)
        assert process.ask("scan", {"X": X}, 60, **job) == {"error": "its process died"}
        assert process.ask("scan", {"X": X}, 60, **job)["k"] == first["k"]


def test_half_an_answer_is_that_of_a_process_that_died(tmp_path):
    dying = tmp_path / "python"
    dying.write_text("#!/bin/sh\nread job\nprintf '{\"k\": 1'\n")
    dying.chmod(0o755)
    with Worker(SCIKIT_LEARN, dying, 1, tmp_path) as process:
        assert process.ask("scan", {}, 60) == {"error": "its process died"}


# Their environment


def test_what_cannot_be_installed_is_told_and_scikit_learn_is_there_all_the_same(
    environment, unreachable
):
    told = []
    found = list(peers.find_peers(environment, (MISSTEP, SCIKIT_LEARN, GMR), told.append))
    own = Path(sys.executable)
    assert [f.python for f in found] == [own, own, None]
    assert not found[0].reason
    assert found[1].reason.startswith("scikit-learn could not be installed: ")
    assert re.fullmatch(r"gmr could not be installed: .+; left out", found[2].reason)
    assert told == ["installing scikit-learn", "installing gmr"]
    assert not list(environment.glob("*.installed"))


def test_every_requirement_is_pinned():
    pins = {line.split("==")[0] for line in peers.PINS.read_text().splitlines() if "==" in line}
    for peer in (SCIKIT_LEARN, GMR, PYPR, peers.POMEGRANATE):
        assert set(peer.requirements) <= pins


def test_the_names_that_numpy_dropped_are_replaced_in_pypr():
    old = (
        "if pdf==None:\n    old = np.NaN\nset_idx = np.nonzero(True - np.isnan(Y))[0]\n"
        "try:\n    pass\nexcept np.linalg.linalg.LinAlgError:\n    pass\n"
    )
    new = peers.modernise(old)
    ast.parse(new)
    lines = ("if pdf is None:", "np.nan", "np.nonzero(~np.isnan(Y))", "np.linalg.LinAlgError")
    assert all(line in new for line in lines)
    assert peers.modernise(new) == new


# What is made of it


def test_ratios_are_between_rows_of_the_same_work_alone():
    rows = [
        Row("em", "misstep", 100, 2, 3, 1, seconds=0.5, log_likelihood=-1.0),
        Row("em", "scikit-learn", 100, 2, 3, 1, seconds=5.0, log_likelihood=-1.0 + 1e-4),
        Row("em", "misstep", 100, 2, 3, 2, seconds=0.25, log_likelihood=-1.0),
        Row("query", "misstep", d=2, k=4, threads=1, p50_us=5.0, p99_us=6.0),
        Row("query", "PyPR", d=2, k=4, threads=1, p50_us=1_000.0, p99_us=1_100.0),
        Row("query", "gmr", d=2, k=4, threads=1, error="longer than 1 s"),
        Row("bic-scan", "misstep", 100, 2, 4, 1, seconds=1.0),
        Row("bic-scan", "scikit-learn", 100, 2, 6, 1, seconds=3.0),
    ]
    one, sklearn, two, query, pypr, gmr, ours, theirs = results.compare(rows)
    assert (one.ratio_to_sklearn, sklearn.ratio_to_sklearn) == (10.0, 1.0)
    assert sklearn.log_likelihood_difference == pytest.approx(1e-4)
    assert two.ratio_to_sklearn is None
    assert (query.ratio_to_pypr, query.ratio_to_gmr) == (200.0, None)
    assert (pypr.ratio_to_pypr, gmr.ratio_to_pypr) == (1.0, None)
    assert (ours.ratio_to_sklearn, theirs.ratio_to_sklearn) == (3.0, 1.0)
    [alone] = results.compare(rows[1:2])
    assert alone.log_likelihood_difference is None


def test_a_slope_is_the_power_of_the_growth():
    rows = [Row("growth-n", "misstep", n, 5, 5, 2, seconds=1e-6 * n**1.3) for n in (10, 100, 1000)]
    rows.append(Row("growth-n", "misstep", 10_000, error="longer than 1 s"))
    [slope] = results.slopes(rows)
    assert slope[:2] == ("misstep", "n")
    assert slope.slope == pytest.approx(1.3)


def test_targets_say_whether_they_were_reached():
    rows = [
        Row("em-scan", "misstep", 6_000, 2, 10, 2, seconds=1.0, ratio_to_sklearn=19.0),
        Row("query", "misstep", d=2, k=10, threads=1, p50_us=9.0, ratio_to_pypr=201.0),
        results.count_right(Row("right-k", "misstep"), [2, 3, 4], [2, 3, 5]),
    ]
    judged = {t.what: t.reached for t in results.targets(rows)}
    assert [reached for what, reached in judged.items() if "EM and BIC" in what] == [False]
    assert [reached for what, reached in judged.items() if "than PyPR" in what] == [True]
    assert [reached for what, reached in judged.items() if "than gmr" in what] == [None]
    assert [reached for what, reached in judged.items() if "median" in what] == [True]
    assert judged["share of random mixtures whose K is found"] is False


def test_the_bare_time_is_that_of_the_scarcer_of_bytes_and_operations():
    rates = hardware.Rates(1, bytes_per_second=1e9, flops_per_second=1e9, exps_per_second=1e8)
    assert hardware.Work(2e9, 1e9, 0).seconds(rates) == 2.0
    assert hardware.Work(1e9, 1e9, 1e8).seconds(rates) == 2.0
    small, large = (hardware.em_work(n, 5, 3, 10).seconds(rates) for n in (100, 200))
    assert large == 2 * small


def test_the_machine_is_measured():
    rates = hardware.measure_rates(1)
    assert all(np.isfinite(rate) and rate > 0 for rate in rates)
    described = hardware.describe_machine()
    assert described["cores"] == os.cpu_count()
    assert described["memory_gib"] > 0


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (3, "3"), (200_000, "200,000"), (0.012345, "0.0123"), (1234.5, "1,234")],
)
def test_numbers_are_told_with_three_digits(value, text):
    assert number(value) == text


# The command


def test_a_bench_without_peers_measures_who_is_there(
    tmp_path, environment, monkeypatch, unreachable, capsys
):
    monkeypatch.setattr(run, "QUICK", TINY)
    out, file = tmp_path / "bench", tmp_path / "result.json"
    words = ("--out", str(out), "--quick", "--peers", str(environment), "--json", str(file))
    assert main(["bench", *words]) == 0
    printed = capsys.readouterr().out
    assert "gmr could not be installed" in printed
    assert "PyPR could not be installed" in printed
    document = json.loads(file.read_text())
    kept = json.loads((out / "bench.json").read_text())
    assert {name: document[name] for name in kept if name != "command"} == {
        name: value for name, value in kept.items() if name != "command"
    }
    rows = document["rows"]
    assert not [row for row in rows if row["error"]]
    assert {row["contender"] for row in rows} == {"misstep", "plain NumPy", "scikit-learn"}
    tasks = ("em", "em-scan", "bic-scan", "query", "growth-n", "memory", "right-k", "trial")
    assert set(tasks) <= {row["task"] for row in rows}
    for row in rows:
        assert row["log_likelihood_difference"] is None or (
            abs(row["log_likelihood_difference"]) < results.SAME
        )
    peak = {row["contender"]: row["n_bytes"] for row in rows if row["task"] == "memory"}
    assert all(count > 0 for count in peak.values())
    [agreement] = [
        row["agreement"]
        for row in rows
        if row["task"] == "query" and row["contender"] == PLAIN_NUMPY.name
    ]
    assert agreement == 1.0
    page = (out / "bench.html").read_text()
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert page.count("<img") == len(list((out / "figures").glob("*.png"))) >= 5
    text = (out / "performance.md").read_text()
    assert text.count("\n## ") == page.count("<h2")
    for line in text.splitlines():
        assert not line.startswith("|") or line.endswith("|")


def test_a_bench_refuses_a_place_where_it_cannot_write(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["bench", "--out", str(tmp_path / "file" / "bench"), "--quick"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
