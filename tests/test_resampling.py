from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from misstep import Column, Outcome, Provenance
from misstep.formats.format import Block, Ending, Episode, Header, joined
from misstep.recordings.angles import Turns, with_angles
from misstep.recordings.clock import on_one_clock
from misstep.recordings.outcomes import judged
from misstep.recordings.resampling import CUTOFF, HALF_WIDTH, at_rate

UNKNOWN = Provenance("", {}, "", None, "")


def episode(observations, actions=None, dt=0.001, costs=None, times=None, size=None, **ending):
    """Return an episode in blocks of `size` rows."""
    table = np.asarray(observations, float)
    table = table[:, None] if table.ndim == 1 else table
    done = np.empty((0, 0)) if actions is None else np.asarray(actions, float).reshape(-1, 1)
    size = size or len(table)
    header = Header(
        None if times is not None else dt,
        tuple(Column(f"c{i}", "") for i in range(table.shape[1])),
        () if actions is None else (Column("u", "N"),),
        UNKNOWN,
    )

    def blocks():
        for i in range(0, len(table), size):
            part = slice(i, i + size)
            yield Block(
                table[part],
                done[part],
                None if costs is None else np.asarray(costs, float)[part],
                None if times is None else np.asarray(times, float)[part],
            )

    return Episode(header, blocks(), lambda: Ending(**ending))


def angle(values, **options):
    made = episode(values, **options)
    return replace(made, header=replace(made.header, observation_columns=(Column("theta", "rad"),)))


# Another rate


@pytest.mark.parametrize("frequency", [1.0, 9.0, 15.0, 25.0, 35.0, 70.0, 211.0])
def test_low_tones_pass_and_high_ones_do_not_come_back_as_others(frequency):
    t = np.arange(4001) * 0.001
    tone = np.sin(2 * np.pi * frequency * t + 0.3)
    out = joined(at_rate(episode(tone), 50.0)).observations[:, 0]
    assert len(out) == 201
    inner = slice(HALF_WIDTH, -HALF_WIDTH)
    if frequency <= 0.32 * 50:
        np.testing.assert_allclose(out[inner], tone[::20][inner], atol=1e-3)
    else:
        assert np.abs(out[inner]).max() < 5e-4  # 66 dB


def test_the_filter_is_the_windowed_sinc_of_scipy():
    rng = np.random.default_rng(0)
    x = rng.normal(size=5001)
    out = joined(at_rate(episode(x), 50.0)).observations[:, 0]
    taps = signal.firwin(2 * HALF_WIDTH * 20 + 1, 2 * CUTOFF / 20, window=("kaiser", 6.76))
    filtered = np.convolve(x, taps, mode="same")[::20]
    np.testing.assert_allclose(out[12:-12], filtered[12:-12], atol=1e-9)


@pytest.mark.parametrize("rate", [50.0, 333.3, 1500.0, 2000.0, 999.0, 100 * np.pi])
def test_slow_motion_comes_through_at_any_pair_of_rates(rate):
    t = np.arange(3001) * 0.001
    motion = np.column_stack([np.cos(3 * t), 2 * t - 1, np.full_like(t, 7.0)])
    out = at_rate(episode(motion), rate)
    rows = joined(out).observations
    assert out.header.dt == 1.0 / rate
    assert len(rows) == int(3.0 * rate + 1e-6) + 1
    at = np.arange(len(rows)) / rate
    np.testing.assert_allclose(rows[:, 1], 2 * at - 1, atol=2e-4)
    np.testing.assert_allclose(rows[:, 2], 7.0, rtol=1e-12)
    inner = slice(HALF_WIDTH, -HALF_WIDTH)
    np.testing.assert_allclose(rows[inner, 0], np.cos(3 * at)[inner], atol=2e-4)


@pytest.mark.parametrize("rate", [50.0, 40.3, 1700.0])
@pytest.mark.parametrize("steps", [40, 900, 4000])
def test_blocks_of_any_size_give_the_same_rows(rate, steps):
    rng = np.random.default_rng(steps)
    x, u, c = rng.normal(size=steps + 1), rng.normal(size=steps), rng.random(steps)
    whole = joined(at_rate(episode(x, u, costs=c), rate))
    for size in (1, 37, 1000):
        parts = joined(at_rate(episode(x, u, costs=c, size=size), rate))
        for name in ("observations", "actions", "costs"):
            np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), atol=1e-12)
    assert len(whole.observations) == len(whole.actions) + 1 == len(whole.costs) + 1


@given(
    st.lists(st.floats(-100, 100), min_size=1, max_size=60),
    st.floats(3.0, 400.0),
    st.integers(1, 60),
)
def test_an_action_is_the_mean_over_its_step(actions, rate, size):
    made = at_rate(episode(np.zeros(len(actions) + 1), actions, dt=0.01, size=size), rate)
    out = joined(made).actions

    # By hand: what the action adds up to until any time, and differences of that.
    def impulse(time):
        whole = int(time / 0.01)
        rest = (time - 0.01 * whole) * actions[whole] if whole < len(actions) else 0.0
        return 0.01 * sum(actions[:whole]) + rest

    for k, action in enumerate(out[:, 0] if len(out) else []):
        mean = (impulse((k + 1) / rate) - impulse(k / rate)) * rate
        assert action == pytest.approx(mean, abs=1e-6 * rate)
    assert abs(len(out) - len(actions) * 0.01 * rate) <= 1.0


def test_an_action_at_its_limit_stays_there():
    out = joined(at_rate(episode(np.zeros(2001), np.full(2000, 0.1)), 50.0))
    np.testing.assert_allclose(out.actions, 0.1, rtol=1e-15)


def test_the_failure_step_is_the_first_row_at_or_after_it():
    for step, expected in ((0, 0), (1, 1), (20, 1), (21, 2), (1000, 50)):
        made = episode(np.zeros(1001), outcome=Outcome.FAILURE, failure_step=step)
        made = at_rate(made, 50.0)
        joined(made)
        assert made.ending().failure_step == expected
        assert made.ending().notes == (
            "rate: from 1000 Hz to 50 Hz, observations filtered below 20.5 Hz",
        )


def test_the_same_rate_changes_nothing():
    made = episode(np.arange(5.0), dt=0.02)
    assert at_rate(made, 50.0) is made
    assert at_rate(made, None) is made


def test_rates_that_are_none_are_refused(refused):
    for rate in (0.0, -1.0, float("nan"), float("inf")):
        with refused("has to be positive"):
            at_rate(episode(np.zeros(3)), rate)
    with refused("uneven times"):
        at_rate(episode(np.zeros(3), times=[0, 1, 3]), 50.0)


# Angles


@pytest.mark.parametrize("low", [-np.pi, 0.0])
@pytest.mark.parametrize("size", [1, 100, 5000])
def test_turns_do_not_smear(low, size):
    t = np.arange(5001) * 0.001
    turning = 2.0 + 7.0 * t
    recorded = (turning - low) % (2 * np.pi) + low
    out = joined(at_rate(angle(recorded, size=size), 50.0)).observations[:, 0]
    there = (turning[::20] - low) % (2 * np.pi) + low
    off = np.abs(out - there)
    # The same angle, and in the same turn but where it is at the very edge.
    np.testing.assert_allclose(np.minimum(off, 2 * np.pi - off), 0.0, atol=1e-6)
    assert (off > 1.0).sum() <= 1
    free = joined(with_angles(angle(recorded, size=size), "unwrapped")).observations[:, 0]
    np.testing.assert_allclose(free, turning - turning[0] + recorded[0], atol=1e-9)
    wrapped = joined(with_angles(angle(recorded, size=size), "wrapped")).observations[:, 0]
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * turning), atol=1e-9)
    assert np.abs(wrapped).max() <= np.pi


def test_only_angles_are_unwrapped():
    jumps = np.array([[3.0, 3.0], [-3.0, -3.0]])
    turns = Turns((Column("x", "m"), Column("theta", "rad")))
    free = turns.unwrap(jumps)
    assert free[:, 0].tolist() == [3.0, -3.0]
    assert free[1, 1] == pytest.approx(2 * np.pi - 3.0)
    np.testing.assert_allclose(turns.rewrap(free), jumps)
    assert turns.wrap(np.array([[9.0, np.pi], [9.0, -np.pi]])).tolist() == [[9, np.pi], [9, np.pi]]


# One clock


@pytest.mark.parametrize("size", [2, 7, 1000])
def test_rows_on_the_clock_are_untouched(size):
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(300, 2)), rng.normal(size=299)
    times = 1.7e9 + np.arange(300) * 0.02 + rng.uniform(-1e-5, 1e-5, 300)
    made = on_one_clock(episode(x, u, times=times, size=size, failure_step=3))
    block = joined(made)
    assert made.header.dt == 0.02
    np.testing.assert_array_equal(block.observations, x)
    np.testing.assert_array_equal(block.actions[:, 0], u)
    assert block.times is None
    assert made.ending() == Ending(failure_step=3)


@pytest.mark.parametrize("even", [0, 50])
@pytest.mark.parametrize("size", [2, 7, 1000])
def test_rows_off_the_clock_are_interpolated_and_it_is_said(size, even):
    rng = np.random.default_rng(1)
    gaps = np.where(np.arange(400) < even, 0.02, rng.uniform(0.005, 0.035, 400))
    times = np.cumsum(gaps)
    turning = 0.5 + 3.0 * (times - times[0])
    x = (turning + np.pi) % (2 * np.pi) - np.pi
    u = rng.normal(size=399)
    made = on_one_clock(angle(x, actions=u, times=times, size=size, failure_step=200), rate=50.0)
    block = joined(made)
    ticks = np.arange(len(block.observations)) * 0.02
    assert len(ticks) == int((times[-1] - times[0]) / 0.02) + 1
    np.testing.assert_allclose(
        np.exp(1j * block.observations[:, 0]), np.exp(1j * (0.5 + 3.0 * ticks)), atol=1e-9
    )
    # The action by hand: sampled finely, averaged over each step.
    fine = np.arange(0, len(ticks) - 1, 1 / 500) * 0.02 + 0.02 / 1000
    held = u[np.searchsorted(times - times[0], fine, side="right") - 1]
    np.testing.assert_allclose(block.actions[:, 0], held.reshape(-1, 500).mean(axis=1), atol=0.02)
    ending = made.ending()
    failed = times[200] - times[0]
    assert abs(ending.failure_step * 0.02 - failed) <= 0.06
    assert "interpolated to a clock of 50 Hz" in ending.notes[0]


def test_over_a_gap_nothing_is_made_up(refused):
    times = np.concatenate([np.arange(100) * 0.02, 4.0 + np.arange(100) * 0.02])
    with refused(r"row 100: 2\.02 s have passed since the row before"):
        joined(on_one_clock(episode(np.zeros(200), times=times, size=30)))


def test_the_rate_is_told_by_the_times():
    for rate in (50.0, 1000.0, 29.97, 0.5):
        made = on_one_clock(episode(np.zeros(100), times=np.round(np.arange(100) / rate, 6)))
        assert made.header.dt == pytest.approx(1 / rate, rel=1e-3)
    assert on_one_clock(episode(np.zeros(9), times=np.arange(9) / 60)).header.dt == 1 / 60


# Outcomes


@pytest.mark.parametrize("size", [1, 3, 50])
def test_formulas_say_what_became_of_it(size):
    x = np.concatenate([np.linspace(0, 1, 21), np.full(10, 1.0)])

    def outcome(failure=None, success=None, hold=0.0):
        made = episode(x, dt=0.1, size=size, outcome=Outcome.SUCCESS)
        made = judged(made, failure=failure, success=success, hold=hold)
        joined(made)
        return made.ending()

    assert outcome(failure="c0 > 0.52") == Ending(
        Outcome.FAILURE, 11, ("outcome: failure, inferred from c0 > 0.52",)
    )
    assert outcome(failure="c0 > 2") == Ending(Outcome.SUCCESS)  # as recorded
    assert outcome(success="c0 > 0.9").outcome is Outcome.SUCCESS
    assert outcome(success="c0 > 0.99", hold=1.0).outcome is Outcome.SUCCESS
    late = outcome(success="c0 > 0.99", hold=1.1)
    assert (late.outcome, late.failure_step) == (Outcome.FAILURE, 30)
    assert late.notes == ("outcome: failure, inferred from not (c0 > 0.99)",)
    both = outcome(failure="c0 > 0.52", success="c0 > 0.9")
    assert (both.outcome, both.failure_step) == (Outcome.FAILURE, 11)


def test_bad_formulas_are_refused(refused):
    for options, reason in (
        ({"failure": "y > 1", "success": None}, "--failure, character 1: no column 'y'"),
        ({"failure": None, "success": "c0 +"}, "--success"),
        ({"failure": None, "success": None, "hold": 1.0}, "--hold needs a --success"),
        ({"failure": None, "success": "c0 > 1", "hold": -1.0}, "at least 0"),
    ):
        with refused(reason):
            judged(episode(np.zeros(3)), **options)
