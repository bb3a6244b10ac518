import asyncio
import json
import shutil
import socket
import time
import zipfile
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from misstep import Dataset, Outcome, make_system, rollout, save_dataset
from misstep.learners import LEARNERS, Task
from misstep.recordings.marking import Mark

pytest.importorskip("fastapi", reason="the live page needs it: pip install 'misstep[live]'")

from misstep.live.attempt import Attempt, action_of, is_one_way
from misstep.live.attempts import ATTEMPTS, PENDING, UNDO, Attempts
from misstep.live.balancing import Balancing
from misstep.live.clock import Clock
from misstep.live.downloads import upload_suffix
from misstep.live.guard import Guard, is_local_name
from misstep.live.hand import Hand
from misstep.live.jobs import describe, read_upload
from misstep.live.lesson import Lesson
from misstep.live.narration import tell_end, tell_trial
from misstep.live.picture import (
    rounded,
    show_mixture,
    show_recording,
    show_system,
    still_columns,
    suggested_state,
)
from misstep.live.protocol import (
    KINDS,
    LONGEST_MESSAGE,
    Allowance,
    Message,
    NotOursError,
    parse,
)
from misstep.live.replay import MODULES, PAGE, replay_html
from misstep.live.server import Page, open_socket
from misstep.live.session import Session
from misstep.live.worker import StoppedError, Worker
from misstep.mixture import GaussianMixture
from misstep.runs import CONFIG

# Messages


def test_a_message_of_the_page_is_read():
    message = parse('{"t": "input", "v": [-1, 0.5], "n": 7}')
    assert (message.kind, message.values) == ("input", {"v": [-1.0, 0.5], "n": 7})
    assert parse('{"t":"push","x":null}').values == {"x": None}
    assert all(parse(json.dumps({"t": kind})).kind == kind for kind in KINDS if not KINDS[kind])


@pytest.mark.parametrize(
    "raw",
    [
        "",
        "[]",
        "17",
        "{",
        "{}",
        '{"t": "input"}',
        '{"t": "input", "v": [2], "n": 1}',
        '{"t": "input", "v": [NaN], "n": 1}',
        '{"t": "push", "x": 1' + "0" * 400 + "}",
        '{"t": "input", "v": [Infinity], "n": 1}',
        '{"t": "input", "v": ["1"], "n": 1}',
        '{"t": "input", "v": [true], "n": 1}',
        '{"t": "input", "v": [1], "n": 1.5}',
        '{"t": "input", "v": [1], "n": -1}',
        '{"t": "input", "v": [1], "n": 1, "more": 1}',
        '{"t": "input", "v": [0,0,0,0,0,0,0,0,0], "n": 1}',
        '{"t": "open_run", "name": 3}',
        '{"t": "open_run", "name": "a\\nb"}',
        '{"t": "__class__"}',
        '{"t": ["input"]}',
        '{"t": "hidden", "hidden": 1}',
        '{"t": "keep", "pad": "' + "x" * LONGEST_MESSAGE + '"}',
        "[" * 4000,
    ],
)
def test_what_is_no_message_of_the_page_is_refused_in_one_line(raw, refused):
    with refused("."):
        parse(raw)
    with pytest.raises(NotOursError):
        parse(raw)


def test_an_allowance_is_a_burst_and_then_its_rate():
    allowance = Allowance(rate=0.0, burst=3.0)
    assert [allowance.take() for _ in range(5)] == [True, True, True, False, False]


# Who may come in


@pytest.mark.parametrize(
    ("host", "local"),
    [
        ("127.0.0.1:8000", True),
        ("127.0.0.1", True),
        ("localhost:8000", True),
        ("[::1]:8000", True),
        ("192.168.1.7:8000", True),
        ("evil.example:8000", False),
        ("127.0.0.1.evil.example:8000", False),
        ("localhost.evil.example", False),
        ("", False),
    ],
)
def test_only_names_that_no_foreign_server_gives_out_are_answered(host, local):
    assert is_local_name(host) is local


@pytest.mark.parametrize(
    ("path", "host", "origin", "passes"),
    [
        ("/token/api", "127.0.0.1:1", None, True),
        ("/token/api", "127.0.0.1:1", "http://127.0.0.1:1", True),
        ("/token/api", "127.0.0.1:1", "http://127.0.0.1:2", False),
        ("/token/api", "127.0.0.1:1", "null", False),
        ("/token/api", "evil.example", None, False),
        ("/token", "127.0.0.1:1", None, False),
        ("/tokenapi", "127.0.0.1:1", None, False),
        ("/toke", "127.0.0.1:1", None, False),
        ("/", "127.0.0.1:1", None, False),
        ("/wrong/api", "127.0.0.1:1", None, False),
    ],
)
def test_token_host_and_origin_decide_who_passes(path, host, origin, passes):
    seen, sent = [], []

    async def app(scope, receive, send):
        seen.append(scope["path"])

    async def send(message):
        sent.append(message)

    headers = [(b"host", host.encode())] + ([(b"origin", origin.encode())] if origin else [])
    scope = {"type": "http", "path": path, "headers": headers}
    asyncio.run(Guard(app, "token", "default-src 'none'")(scope, None, send))
    assert seen == (["/api"] if passes else [])
    assert passes or sent[0]["status"] == 403


@pytest.mark.parametrize("name", ["a.exe", "..", "a.h5/../../x", "a", ".h5x", "a.h5\x00"])
def test_an_uploaded_name_gives_a_known_suffix_or_nothing(name, refused):
    with refused("is not known here"):
        upload_suffix(name)
    assert upload_suffix("../../etc/passwd.H5") == ".h5"


@pytest.mark.parametrize("name", ["../../outside.h5", "/outside.h5", "D.h5"])
def test_what_was_packed_is_read_from_inside_its_own_folder(name, demonstrations, tmp_path):
    inner = tmp_path / "a" / "b"
    inner.mkdir(parents=True)
    save_dataset(demonstrations, tmp_path / "D.h5")
    with zipfile.ZipFile(inner / "upload.zip", "w") as archive:
        archive.write(tmp_path / "D.h5", name)
    read = read_upload(_say, _stop, path=inner / "upload.zip", system="cartpole", parameters={})
    assert read == list(demonstrations)
    files = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()}
    assert files == {"D.h5", "a/b/upload.zip", f"a/b/upload/{name.rpartition('/')[2]}"}


def test_what_is_no_zip_file_is_refused(tmp_path, refused):
    (tmp_path / "upload.zip").write_bytes(b"PK\x03\x04 and no more")
    with refused("no zip file that can be unpacked"):
        read_upload(_say, _stop, path=tmp_path / "upload.zip", system="cartpole", parameters={})


def _say(kind, value):
    raise AssertionError(f"nobody asked for {kind}")


def _stop():
    return "halt"


def test_a_page_that_reads_nothing_is_given_up_and_holds_no_more():
    class Stalled:
        """The other end of a socket whose buffers are full."""

        sent = 0

        async def send_text(self, text):
            self.sent += 1
            await asyncio.Event().wait()

    async def run():
        stalled = Stalled()
        page = Page(stalled)
        given_up = asyncio.create_task(page.send_all())
        for _ in range(5000):
            page.news("x")
            page.frame("y")
            await asyncio.sleep(0)
            if given_up.done():
                break
        return await given_up, stalled.sent, len(page._news)

    reason, sent, waiting = asyncio.run(run())
    assert "does not read" in reason
    assert sent == 1
    assert waiting <= 400


def test_a_worker_that_is_busy_does_not_hold_up_who_asks_for_more(demonstrations, tmp_path):
    save_dataset(demonstrations, tmp_path / "D.h5")

    async def run():
        worker = Worker()
        described = asyncio.create_task(worker.do("describe", attempts=str(tmp_path / "D.h5")))
        await asyncio.sleep(0)
        # Far more than a pipe holds, while the worker has not even begun to read.
        out = tmp_path / "hdf5" / "attempts.h5"
        out.parent.mkdir()
        asked = worker.do("write", attempts=[demonstrations[0]] * 200, out=str(out))
        written = asyncio.create_task(asked)
        for _ in range(3):
            await asyncio.sleep(0)
        early = described.done()
        try:
            return early, await described, await written
        finally:
            worker.stop()

    early, described, written = asyncio.run(run())
    assert not early
    assert json.loads(described)["state"] == ["x", "x_dot", "theta", "theta_dot"]
    assert written.endswith("attempts.h5")


def test_who_waited_for_a_worker_that_died_is_told_although_another_is_there(
    demonstrations, tmp_path
):
    save_dataset(demonstrations, tmp_path / "D.h5")

    async def run():
        worker = Worker()
        job = {"attempts": str(tmp_path / "D.h5")}
        first = asyncio.create_task(worker.do("describe", **job))
        await asyncio.sleep(0)
        worker._process.kill()
        worker._process.join()  # and nobody has had a turn to say so
        try:
            told = await worker.do("describe", **job)
            with pytest.raises(StoppedError):
                await asyncio.wait_for(first, 10)
            return told
        finally:
            worker.stop()

    assert json.loads(asyncio.run(run()))["state"]


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_it_listens_on_addresses_of_both_kinds(host):
    if host == "::1" and not _has_ipv6():
        pytest.skip("this machine has no IPv6")
    with open_socket(host, 0) as listening:
        socket.create_connection((host, listening.getsockname()[1]), 10.0).close()


def _has_ipv6():
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return True


# Driving


def test_an_attempt_by_hand_is_what_a_rollout_of_the_same_actions_is(cartpole):
    actions = iter(10.0 * np.sin(np.arange(2000.0)))

    class Same:
        def reset(self):
            pass

        def __call__(self, observation):
            return np.array([next(actions)])

    expected = rollout(cartpole, Same(), seed=5, demonstrator="person", time="")
    attempt = Attempt(cartpole, 5)
    for action in expected.actions:
        assert not attempt.over
        attempt.step(action)
    made = attempt.trajectory()
    assert attempt.over
    assert made.outcome is expected.outcome is Outcome.FAILURE
    assert made.failure_step == expected.failure_step
    for part in ("observations", "actions", "costs"):
        assert np.array_equal(getattr(made, part), getattr(expected, part))
    assert made.provenance.parameters == expected.provenance.parameters


def test_a_person_can_say_that_it_has_failed_and_where_it_starts(cartpole):
    attempt = Attempt(cartpole, 0, start_angle=0.1)
    assert attempt.observation[2] == 0.1
    assert attempt.trajectory() is None
    for _ in range(4):
        attempt.step(np.zeros(1))
    attempt.fail_now()
    made = attempt.trajectory(("driven slowly",))
    assert (made.outcome, made.failure_step, made.n_steps) == (Outcome.FAILURE, 4, 4)
    assert made.provenance.notes[0] == "driven slowly"
    assert any("marked by hand" in note for note in made.provenance.notes)


def test_a_push_is_a_share_of_the_range_on_both_sides_or_on_one(cartpole):
    assert action_of(cartpole, [0.5], 0.4) == pytest.approx([0.2 * 20.0])
    assert action_of(cartpole, [-1.0], 1.0) == pytest.approx([-20.0])
    assert action_of(cartpole, [], 1.0) == pytest.approx([0.0])
    strike = make_system("basket")
    assert is_one_way(strike)
    assert action_of(strike, [-1.0], 1.0) == pytest.approx([0.0])
    assert action_of(strike, [1.0], 0.5) == pytest.approx([0.5 * strike.parameters["v_max"]])


def test_the_hand_pushes_at_the_tip_of_the_pole():
    system = make_system("cartpole", pole_mass=0.3, half_length=0.7)
    system.reset(seed=0)
    system.set_state(0.2, 0.0, 0.5, 0.0)
    hand = Hand(system)
    hand.hold(100.0)
    hand.act()
    mujoco.mj_forward(system.model, system.data)
    acting = system.data.qfrc_passive * 0.0
    force = system.data.xfrc_applied[system.model.body("pole").id, 0]
    tip = np.array([0.2 + 1.4 * np.sin(0.5), 0.0, 1.4 * np.cos(0.5)])
    mujoco.mj_applyFT(
        system.model,
        system.data,
        np.array([force, 0.0, 0.0]),
        np.zeros(3),
        tip,
        system.model.body("pole").id,
        acting,
    )
    # By virtual work: F on the cart, and F times the height of the tip on the hinge.
    assert acting == pytest.approx([force, force * 1.4 * np.cos(0.5)])
    assert 0.0 < force <= 0.3 * 9.81
    by_wrench = np.zeros(2)
    wrench = system.data.xfrc_applied[system.model.body("pole").id]
    centre = system.data.xipos[system.model.body("pole").id]
    mujoco.mj_applyFT(
        system.model,
        system.data,
        wrench[:3].copy(),
        wrench[3:].copy(),
        centre.copy(),
        system.model.body("pole").id,
        by_wrench,
    )
    assert by_wrench == pytest.approx(acting)
    hand.hold(None)
    hand.act()
    assert not system.data.xfrc_applied.any()


def test_no_tick_comes_early_and_the_clock_does_not_drift():
    async def run():
        clock = Clock(0.004)
        start = time.monotonic()
        for n in range(1, 40):
            await clock.tick()
            assert time.monotonic() - start >= n * 0.004 - 1e-4 or clock.late
        return clock

    clock = asyncio.run(run())
    assert clock.ticks == 39
    assert clock.late <= clock.ticks


class _Raises:
    def reset(self):
        pass

    def __call__(self, observation):
        raise ValueError("no\nanswer")


class Told:
    """A page without a socket, and what it is told."""

    def __init__(self):
        self.told = []

    def news(self, message):
        self.told.append(json.loads(message))

    def frame(self, message):
        pass


def test_a_system_that_cannot_be_had_leaves_the_present_one(tmp_path, refused):
    async def run():
        session = Session(tmp_path, "cartpole", {})
        page = Told()
        session.join(page)
        (tmp_path / "flipup").mkdir()
        (tmp_path / "flipup" / "runs").write_text("no folder")
        with refused("cannot make the folder"):
            session.do(page, Message("system", {"name": "flipup"}))
        assert session.name == session.driving.system.system_id == "cartpole"
        assert session.attempts.folder == tmp_path / "cartpole"
        session.close()

    asyncio.run(run())


def test_runs_of_any_learner_are_listed_and_counted(tmp_path, monkeypatch):
    async def run():
        lesson = Lesson(Worker(), tmp_path, 0, lambda: None)
        for name in ("002-fall", "007-My_learner.v2", "notes", "x-fall"):
            (tmp_path / name).mkdir()
            (tmp_path / name / CONFIG).touch()
        assert lesson.runs() == ["007-My_learner.v2", "002-fall"]
        monkeypatch.setitem(LEARNERS._own, "own/learner", LEARNERS["mean"])
        lesson.learn("own/learner", ["x"], 1, 1).close()
        assert lesson.run["name"] == "008-own-learner"

    asyncio.run(run())


def test_time_goes_on_after_a_policy_that_fails_and_a_disk_that_refuses(tmp_path):
    async def until(is_so):
        while not is_so():
            await asyncio.sleep(0.001)

    async def run():
        session = Session(tmp_path / "data", "cartpole", {})
        page = Told()
        session.join(page)
        living = asyncio.create_task(session.live())
        do = lambda kind, **values: session.do(page, Message(kind, values))  # noqa: E731
        try:
            session._set_mode("balancing")
            session.balancing = Balancing("cartpole", {}, _Raises(), np.random.default_rng(0))
            await until(lambda: session.mode == "ready")
            assert session.note == "it was stopped: ValueError: no answer"
            assert session.attempts.pending is None

            do("settings", strength=1.0, speed=2.0, start_angle=10.0, countdown=0)
            do("begin")
            shutil.rmtree(session.attempts.folder)
            await until(lambda: session.mode == "ended")
            assert "in memory alone" in session.note
            await until(lambda: page.told[-1].get("note") == session.note)
            assert session.attempts.pending.outcome is Outcome.FAILURE
            session.attempts.folder.mkdir()
            do("keep")
            assert session.mode == "ready"
            assert len(Attempts(session.attempts.folder)) == 1

            do("begin")
            await until(lambda: session.mode == "ended")
            assert not living.done()
        finally:
            living.cancel()
            session.close()

    asyncio.run(asyncio.wait_for(run(), 60))


# What is kept


def test_changes_are_taken_back_in_the_reverse_of_their_order(demonstrations, tmp_path):
    attempts = Attempts(tmp_path)
    a, b, c = attempts.add(list(demonstrations))
    attempts.delete(b)
    attempts.mark(c, Mark(failure_time=0.2))
    attempts.delete(a)
    attempts.put_aside(demonstrations[0])
    attempts.discard()
    assert [kept.id for kept in attempts] == [c]
    again = Attempts(tmp_path)  # the server was started again in between
    for _ in range(4):
        again.undo()
    # What was thrown away while it waited is at the end, the others are where they were.
    assert [k.trajectory for k in again] == [*demonstrations, demonstrations[0]]
    assert not again.can_undo
    assert Dataset(k.trajectory for k in Attempts(tmp_path)) == again.dataset


def test_a_new_attempt_survives_what_is_taken_back_after_it(demonstrations, tmp_path):
    attempts = Attempts(tmp_path)
    first, second = attempts.add(list(demonstrations[:2]))
    attempts.mark(second, Mark(outcome=Outcome.UNKNOWN))
    attempts.put_aside(demonstrations[2])
    attempts.keep()
    attempts.delete(first)
    attempts.undo()
    attempts.undo()
    assert attempts.dataset == demonstrations


def test_a_process_killed_between_copy_and_change_takes_nothing_back(demonstrations, tmp_path):
    attempts = Attempts(tmp_path)
    first, _, _ = attempts.add(list(demonstrations))
    before = attempts.path.read_bytes()
    attempts.delete(first)
    attempts.path.write_bytes(before)  # as if the change had not been reached
    again = Attempts(tmp_path)
    assert again.can_undo
    with pytest.raises(ValueError, match="nothing to take back"):
        again.undo()
    assert again.dataset == demonstrations


def test_a_mark_is_taken_back_only_where_its_attempt_still_is(demonstrations, tmp_path, refused):
    attempts = Attempts(tmp_path)
    (only,) = attempts.add([demonstrations[0]])
    attempts.mark(only, Mark(outcome=Outcome.UNKNOWN))
    attempts.path.unlink()  # somebody has taken all of them away
    with refused("nothing to take back"):
        Attempts(tmp_path).undo()


def test_what_waits_is_in_a_file_until_it_is_kept_once(demonstrations, tmp_path):
    attempts = Attempts(tmp_path)
    attempts.put_aside(demonstrations[0])
    assert Attempts(tmp_path).pending == demonstrations[0]
    pending = (tmp_path / PENDING).read_bytes()
    attempts.keep()
    (tmp_path / PENDING).write_bytes(pending)  # killed after it was appended
    again = Attempts(tmp_path)
    assert again.pending is None
    assert len(again) == 1
    assert not (tmp_path / PENDING).exists()


def test_deleting_all_leaves_no_file_and_undo_brings_it_back(demonstrations, tmp_path, refused):
    attempts = Attempts(tmp_path)
    (only,) = attempts.add([demonstrations[0]])
    attempts.delete(only)
    assert not (tmp_path / ATTEMPTS).exists()
    with refused("nothing has been kept"):
        _ = attempts.dataset
    with refused("not there any more"):
        attempts.delete(only)
    attempts.undo()
    assert attempts.dataset == demonstrations[:1]
    assert not list((tmp_path / UNDO).iterdir())


# What the page is shown


def test_numbers_are_rounded_to_five_digits_and_none_is_not_finite():
    assert rounded(np.array([[1.0, 0.123456789], [np.inf, -1e-9]])) == [
        [1.0, 0.12346],
        [None, -1e-9],
    ]


def test_the_mixture_that_is_shown_conditions_as_the_one_that_was_fitted(cartpole, demonstrations):
    task = Task.of(cartpole)
    shown = json.loads(
        json.dumps(show_mixture(task, tuple(demonstrations), None, np.random.default_rng(0)))
    )
    mixture = GaussianMixture.from_parameters(
        shown["weights"] / np.sum(shown["weights"]), shown["means"], shown["covariances"]
    )
    x = demonstrations[0].observations[5]
    conditional = mixture.condition(range(4), x)
    whitened = np.einsum("kij,kj->ki", shown["state_whiteners"], x - np.array(shown["state_means"]))
    logs = np.array(shown["state_constants"]) - 0.5 * (whitened**2).sum(axis=1)
    h = np.exp(logs - logs.max())
    assert h / h.sum() == pytest.approx(conditional.weights, abs=1e-3)


def test_a_column_that_never_varies_shows_no_mixture(cartpole, demonstrations):
    still = replace(demonstrations[0], actions=np.zeros_like(demonstrations[0].actions))
    assert show_mixture(Task.of(cartpole), (still,), None, np.random.default_rng(0)) is None


def test_a_column_that_stands_still_is_left_out_of_what_is_shown(demonstrations, tmp_path):
    def still(trajectory):
        observations = trajectory.observations.copy()
        observations[:, 1] = 0.25
        return replace(trajectory, observations=observations)

    changed = [still(trajectory) for trajectory in demonstrations]
    assert still_columns(list(demonstrations)) == still_columns([]) == []
    assert still_columns(changed) == ["x_dot"]
    save_dataset(Dataset(changed), tmp_path / "D.h5")
    shown = json.loads(describe(_say, _stop, attempts=tmp_path / "D.h5"))
    assert shown["state"] == ["x", "theta", "theta_dot"]


def test_the_cart_is_left_out_only_where_no_end_of_the_rail_is_in_reach():
    assert suggested_state(make_system("cartpole")) == ["theta", "theta_dot"]
    for name in ("cartpole-rail", "cartpole-swingup", "basket"):
        system = make_system(name)
        assert suggested_state(system) == [c.name for c in system.observation_columns]


def test_the_sentences_say_which_way_it_fell(cartpole, demonstrations):
    for attempt in demonstrations:
        side = "right" if attempt.column("theta")[attempt.failure_step] > 0 else "left"
        sentence = tell_trial(2, attempt, cartpole, "fall", None)
        assert sentence.startswith(
            f"Trial 2 fell to the {side} after {attempt.failure_time:.2f} s."
        )
    rail = make_system("cartpole-rail", track_limit=0.05)
    made = rollout(rail, _Constant(5.0), seed=0, demonstrator="person")
    assert tell_end(made, rail).startswith("left the track on the right")


class _Constant:
    def __init__(self, force):
        self.force = np.array([force])

    def reset(self):
        pass

    def __call__(self, observation):
        return self.force


def test_every_system_is_shown_as_json():
    for name in ("cartpole", "cartpole-swingup", "flipup", "basket", "gym:Pendulum-v1"):
        system = make_system(name)
        shown = json.loads(json.dumps(show_system(name, system), allow_nan=False))
        assert [c["name"] for c in shown["columns"]] == [c.name for c in system.observation_columns]


def test_the_replay_is_one_file_that_asks_for_nothing(demonstrations):
    recording = json.dumps({"id": 1, **show_recording(demonstrations[0])})
    html = replay_html({"note": "</script><script>alert(1)</script>"}, [recording], [])
    assert "</script><script>alert" not in html
    assert 'src="' not in html
    assert '<link rel="stylesheet"' not in html
    for name in MODULES:
        assert f'"misstep/{name}": "data:' in html
    told = html.split('id="replay-data">')[1].split("</script>")[0]
    assert json.loads(told)["recordings"] == [json.loads(recording)]


def test_no_part_of_the_page_names_an_address_outside():
    for part in PAGE.iterdir():
        text = part.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
        assert "://" not in text, part.name
        if part.name.endswith(".js"):
            assert part.name in MODULES
