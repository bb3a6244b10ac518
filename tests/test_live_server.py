"""A hostile world: whatever is sent to the server, it answers in one sentence and loses nothing."""

import json
import signal
import time
import urllib.error
import urllib.request
from contextlib import ExitStack

import numpy as np
import pytest
from live_server import LiveServer

from misstep import demonstrate, load_dataset, load_run, make_system, save_dataset
from misstep.cli import main
from misstep.formats import FORMATS
from misstep.live.downloads import MOST_UPLOADED

connect = pytest.importorskip(
    "websockets.sync.client", reason="the live page needs it: pip install 'misstep[live]'"
).connect

PATIENCE = 60.0


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    server = LiveServer(tmp_path_factory.mktemp("live") / "data")
    yield server
    server.close()


def request(server, path, method="GET", data=None, headers=(), token=None):
    """Return the status and the body of an answer."""
    address = f"http://127.0.0.1:{server.port}/{token or server.token}/{path}"
    asked = urllib.request.Request(address, data=data, method=method, headers=dict(headers))
    try:
        with urllib.request.urlopen(asked, timeout=PATIENCE) as answer:  # noqa: S310
            return answer.status, answer.read(), dict(answer.headers)
    except urllib.error.HTTPError as error:
        return error.code, error.read(), dict(error.headers)


class Socket:
    """A page without a browser."""

    def __init__(self, server, origin=None, token=None):
        address = f"ws://127.0.0.1:{server.port}/{token or server.token}/socket"
        origin = origin or f"http://127.0.0.1:{server.port}"
        self._context = ExitStack()
        self.socket = self._context.enter_context(
            connect(address, origin=origin, open_timeout=PATIENCE, max_size=2**24)
        )

    def send(self, kind, **values):
        self.socket.send(json.dumps({"t": kind, **values}))

    def until(self, kind, accept=lambda message: True):
        """Return the next message of a kind that is as wanted."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            message = json.loads(self.socket.recv(timeout=PATIENCE))
            if message["t"] == "session":
                self.latest = message
            if message["t"] == kind and accept(message):
                return message
        raise AssertionError(f"no {kind} came")

    def session(self, **wanted):
        return self.until("session", lambda m: all(m[k] == v for k, v in wanted.items()))

    def fail(self, direction=1.0):
        """Drive until it falls, and return what waits to be kept."""
        self.send("settings", strength=0.8, speed=2.0, start_angle=3.0, countdown=0)
        self.send("begin")
        self.send("input", v=[direction], n=1)
        while True:
            state = self.until("session", lambda m: m["mode"] in ("ended", "paused"))
            if state["mode"] == "ended":
                return state
            self.send("resume")  # on a busy machine silence is soon too long

    def close(self):
        self._context.close()


@pytest.fixture
def page(server):
    page = Socket(server)
    state = page.session()
    if not state["drives"]:  # the one before is not gone yet
        page.send("take")
        state = page.session(drives=True)
    if state["mode"] in ("driving", "paused", "countdown"):
        page.send("stop")
        page.send("alive")
    yield page
    page.close()


def attempts_file(server):
    return server.folder / "cartpole" / "attempts.h5"


def test_a_wrong_token_origin_or_host_gets_one_sentence_and_nothing_else(server):
    status, body, _ = request(server, "", token="A" * 24)
    assert (status, body.count(b"\n")) == (403, 1)
    assert b"token" in body
    status, body, _ = request(server, "api/formats", headers={"Origin": "http://evil.example"})
    assert status == 403
    assert b"another page" in body
    status, body, _ = request(server, "", headers={"Host": "evil.example"})
    assert status == 403
    # An upload, and the question whether it would be allowed.
    for method in ("PUT", "OPTIONS"):
        foreign = {"Origin": "http://evil.example"}
        assert request(server, "api/upload?name=x.h5", method, b"x", foreign)[0] == 403
    for path in ("api/download/csv", "api/replay", "api/upload?name=x.h5"):
        assert request(server, path, token="A" * 24)[0] == 403
    for wrong in ({"token": "A" * 24}, {"origin": "http://evil.example"}):
        with pytest.raises(Exception, match="403"):
            Socket(server, **wrong)


def test_the_page_forbids_everything_from_elsewhere(server):
    status, body, headers = request(server, "")
    assert status == 200
    assert b"misstep/app.js" in body
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "http" not in policy
    assert headers["referrer-policy"] == "no-referrer"


@pytest.mark.parametrize(
    "path",
    [
        "page/../server.py",
        "page/..%2fserver.py",
        "page/%2e%2e/server.py",
        "page/%2fetc%2fpasswd",
        "api/download-run/..",
        "api/download-run/..%2f..%2ftoken",
        "page/icon.svg",
        "api/attempt/-1",
        "api/attempt/abc",
        "api/download/..%2fx",
        "api/run/1/1",
    ],
)
def test_no_path_leads_out_of_what_is_offered(server, path):
    status, body, _ = request(server, path)
    assert status in (400, 403, 404, 422)
    assert server.token.encode() not in body


def test_an_attempt_is_kept_replayed_downloaded_and_dropped_in_again(server, page, tmp_path):
    pending = page.fail()["pending"]
    assert pending["outcome"] == "failure"
    page.send("keep")
    kept = page.until("session", lambda m: m["attempts"] and m["mode"] == "ready")["attempts"]
    on_disk = load_dataset(attempts_file(server))
    assert len(on_disk) == len(kept)
    trajectory = on_disk[-1]
    assert trajectory.provenance.demonstrator == "person"
    assert trajectory.actions.max() == pytest.approx(16.0)

    status, body, _ = request(server, f"api/attempt/{kept[-1]['id']}")
    assert status == 200
    shown = json.loads(body)
    assert np.allclose(shown["observations"], trajectory.observations, rtol=1e-4, atol=1e-9)
    formats = json.loads(request(server, "api/formats")[1])["formats"]
    convertible = {name for name, entry in FORMATS.items() if entry.write is not None}
    assert {entry["name"] for entry in formats} == convertible
    for n, entry in enumerate(formats, start=1):
        status, body, headers = request(server, f"api/download/{entry['name']}?id={kept[-1]['id']}")
        assert status == 200
        assert headers["content-disposition"].endswith(entry["suffix"])
        # What has no suffix of its own is told by what is in it.
        name = f"x{entry['suffix'] or '.h5'}"
        status, body, _ = request(server, f"api/upload?name={name}", "PUT", body)
        assert (status, json.loads(body)) == (200, {"added": 1}), entry["name"]
        back = load_dataset(attempts_file(server))
        assert len(back) == len(kept) + n
        assert np.allclose(back[-1].actions, trajectory.actions), entry["name"]
    replay = request(server, "api/replay")[1]
    assert b"replay-data" in replay
    assert str(server.folder).encode() not in replay


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("x.h5", b"", "empty"),
        ("x.h5", b"no HDF5 at all", "cannot read it"),
        ("x.h5", b"\x89HDF\r\n\x1a\n" + bytes(2000), "cannot read it"),
        ("x.csv", b"a,b\n1,2\n", ""),
        ("x.zip", b"PK", "no zip file"),
        ("x.exe", b"MZ", "not known here"),
        ("../../attempts", b"x", "not known here"),
    ],
)
def test_a_broken_upload_is_refused_in_one_sentence(server, page, name, content, said):
    before = attempts_file(server).read_bytes() if attempts_file(server).exists() else None
    status, body, _ = request(server, f"api/upload?name={name}", "PUT", content)
    assert status == 400
    problem = json.loads(body)["problem"]
    assert said in problem
    assert "\n" not in problem
    assert "upload" not in problem
    after = attempts_file(server).read_bytes() if attempts_file(server).exists() else None
    assert after == before


def test_an_upload_of_another_system_is_refused(server, page, tmp_path, demonstrations):
    save_dataset(demonstrate(make_system("basket"), by="timid", n=1), tmp_path / "b.h5")
    content = (tmp_path / "b.h5").read_bytes()
    status, body, _ = request(server, "api/upload?name=b.h5", "PUT", content)
    assert status == 400
    assert "but cartpole has x, x_dot, theta, theta_dot, force" in json.loads(body)["problem"]


def test_a_huge_upload_is_refused_before_it_fills_the_disk(server):
    class Endless:
        """More than is taken, without being held in memory."""

        left = MOST_UPLOADED + 2**20

        def read(self, n):
            n = min(n, self.left)
            self.left -= n
            return bytes(n)

    length = str(Endless.left)
    try:
        status, body, _ = request(
            server, "api/upload?name=x.h5", "PUT", Endless(), {"Content-Length": length}
        )
    except (ConnectionError, urllib.error.URLError):
        status, body = 400, b"larger than 64 MB"  # it hung up before all was sent
    assert status == 400
    assert b"larger than 64 MB" in body


def test_messages_that_are_not_ours_are_told_and_then_the_page_is_left(server, page):
    page.socket.send("what?")
    assert "not JSON" in page.until("problem")["text"]
    page.send("delete", id=999999)
    assert "not there any more" in page.until("problem")["text"]
    with pytest.raises(Exception, match="messages that are not ours"):  # noqa: PT012
        for _ in range(30):
            page.socket.send(b"\x00\x01")
            page.until("problem")


def test_a_flood_closes_the_socket_and_what_was_recorded_is_there(server, page):
    page.fail()
    page.send("keep")
    page.session(mode="ready")
    before = len(load_dataset(attempts_file(server)))
    with pytest.raises(Exception, match="far too many messages"):  # noqa: PT012
        for n in range(10000):
            page.send("input", v=[0.0], n=n)
        while True:
            page.until("session")
    again = Socket(server)
    assert len(again.session()["attempts"]) == before
    again.close()


def test_what_is_thrown_away_in_mid_attempt_can_be_taken_back(server, page):
    if page.latest["mode"] == "ended":
        page.send("discard")
        page.session(mode="ready")
    before = page.latest["attempts"]
    page.send("settings", strength=0.5, speed=0.3, start_angle=0.0, countdown=0)
    page.send("begin")
    page.until("f", lambda frame: frame["k"] >= 3)
    page.send("restart")
    page.send("hidden", hidden=True)
    page.session(mode="paused")
    page.send("stop")
    page.until("session", lambda m: m["mode"] in ("ended", "ready"))
    page.send("undo")
    back = page.until("session", lambda m: len(m["attempts"]) == len(before) + 1)["attempts"][-1]
    assert back["outcome"] == "unknown"
    assert back["duration"] >= 3 * 0.02
    assert load_dataset(attempts_file(server))[-1].provenance.notes[0].endswith("of real time")
    if page.latest["mode"] == "ended":
        page.send("discard")
        page.session(mode="ready")


def test_of_two_tabs_one_drives_and_the_other_can_take_over(server, page):
    page.send("settings", strength=0.5, speed=0.05, start_angle=0.0, countdown=0)
    page.send("begin")
    page.session(mode="driving")
    second = Socket(server)
    assert second.session()["drives"] is False
    second.send("stop")
    assert "another tab drives" in second.until("problem")["text"]
    second.send("take")
    taken = second.session(drives=True)
    assert taken["mode"] == "paused"
    assert page.session(drives=False)["mode"] == "paused"
    second.send("resume")
    second.session(mode="driving")
    second.send("hidden", hidden=True)
    assert "hidden" in second.session(mode="paused")["note"]
    second.send("resume")
    second.session(mode="driving")
    second.close()
    # Whoever is left drives, and what was being recorded waits.
    left = page.session(drives=True)
    assert left["mode"] == "paused"
    page.send("stop")
    page.until("session", lambda m: m["mode"] in ("ended", "ready"))
    page.send("restart")
    page.session(mode="driving")


def test_ctrl_c_in_mid_attempt_puts_aside_what_was_driven(server, page):
    page.send("discard")
    page.send("settings", strength=0.5, speed=0.2, start_angle=0.0, countdown=0)
    page.send("restart")
    page.send("input", v=[0.1], n=1)
    page.session(mode="driving")
    page.until("f", lambda frame: frame["k"] >= 5)
    code, said = server.stop(signal.SIGINT)
    assert code == 130
    assert said.count("\n") == 1
    assert "all that was recorded is in" in said
    with pytest.raises(Exception, match=r"1012|1001"):  # noqa: PT012
        while True:
            page.until("session")
    address = server.url
    server.start()
    assert server.url == address
    again = Socket(server)
    state = again.session()
    assert state["mode"] == "ended"
    assert "end: the server was stopped" in state["pending"]["notes"]
    again.send("keep")
    again.session(mode="ready")
    assert load_dataset(attempts_file(server))[-1].n_steps >= 5
    again.close()


def test_a_run_that_was_killed_goes_on_and_every_command_can_use_it(
    server, page, tmp_path, demonstrations
):
    save_dataset(demonstrations, tmp_path / "D.h5")
    content = (tmp_path / "D.h5").read_bytes()
    assert request(server, "api/upload?name=D.h5", "PUT", content)[0] == 200
    page.send("learn", learner="random-linear", state=[], max_trials=3, seed=4)
    # The page watches the first trial and never says that it has: the server waits.
    first = page.until("session", lambda m: m["run"] and m["run"]["trials"])
    assert first["mode"] in ("learning", "ready")
    server.kill()
    server.start()
    again = Socket(server)
    name = again.session()["runs"][0]
    again.send("pace", watch=False)
    again.send("resume_run", name=name)
    again.session(mode="learning")
    done = again.session(mode="ready")["run"]
    folder = server.folder / "cartpole" / "runs" / name
    run = load_run(folder)
    assert run.finished
    assert [t["outcome"] for t in done["trials"]] == [str(t.outcome) for t in run.trials]
    _, body, _ = request(server, f"api/run/{done['key']}/1")
    assert np.allclose(json.loads(body)["actions"], run.trials[0].actions, rtol=1e-4, atol=1e-9)
    status, body, _ = request(server, f"api/download-run/{name}")
    assert (status, body[:2]) == (200, b"PK")
    again.send("balance")
    assert again.session(mode="balancing")
    again.send("push", x=1.0)
    assert again.until("f", lambda frame: frame["k"] > 3 and frame.get("hold") == 1.0)
    again.send("rest")
    again.session(mode="ready")
    again.close()
    assert main(["evaluate", str(folder), "--episodes", "2"]) in (0, 1)


def test_a_taken_port_is_told_in_one_line(server, tmp_path, capsys):
    code = main(
        ["live", "--no-browser", "--port", str(server.port), "--data", str(tmp_path / "data")]
    )
    said = capsys.readouterr().err
    assert code == 2
    assert said.count("\n") == 1
    assert "choose another --port" in said


def test_what_cannot_be_read_at_the_start_is_told_in_one_line(tmp_path, capsys):
    file = tmp_path / "data" / "cartpole" / "attempts.h5"
    file.parent.mkdir(parents=True)
    file.write_bytes(b"no recording")
    code = main(["live", "--no-browser", "--port", "0", "--data", str(tmp_path / "data")])
    said = capsys.readouterr().err
    assert code == 2
    assert said.count("\n") == 1
    assert str(file) in said
    assert file.read_bytes() == b"no recording"
