"""The studies that the project brings along can be read, and hold the baselines."""

from pathlib import Path

import pytest

from misstep.study import load_study

STUDIES = Path(__file__).parents[1] / "studies"


@pytest.mark.parametrize("name", ["headline", "small"])
def test_a_study_is_read_whole_and_holds_its_baselines(name):
    study = load_study(STUDIES / f"{name}.toml")
    assert len(study.cells) > 1000
    learners = {str(cell.learner) for cell in study.cells}
    for wanted in ("fall", "donut", "random-linear", "widest-gap"):
        assert any(wanted in learner for learner in learners)
