"""Passwords, tokens and signatures in URLs: a run works with them and keeps none of them.

Searched for are the secrets themselves, in all files of the dataset, of Prefect and of the cache,
and in all that was printed.
"""

import functools
import http.server
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from typer.testing import CliRunner

from epipole.flows.command_line.main import app
from epipole.io.paths import SECRETS, _with_secrets, known_as, line_of
from epipole.schemas.text import without_secrets

PASSWORD, TOKEN = "pw-Zq83kd", "tok-9fJw2x"


class _Handler(http.server.SimpleHTTPRequestHandler):
    """Serves ranges of files to those who know the password and the token."""

    def do_GET(self):
        self.send_head()

    def do_HEAD(self):
        self.send_head()

    def send_head(self):
        data = self._data()
        if data is None:
            return
        first, last = 0, len(data) - 1
        wanted = self.headers.get("Range")
        if wanted:
            start, _, end = wanted.removeprefix("bytes=").partition("-")
            first, last = int(start), min(int(end or last), last)
        self.send_response(206 if wanted else 200)
        self.send_header("Content-Length", str(last + 1 - first))
        self.send_header("Content-Range", f"bytes {first}-{last}/{len(data)}")
        self.send_header("Accept-Ranges", "bytes")
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(data[first : last + 1])

    def _data(self):
        path, _, query = self.path.partition("?")
        file = Path(self.directory) / path.lstrip("/")
        if "Authorization" not in self.headers or TOKEN not in query:
            self.send_error(403)
        elif not file.is_file():
            self.send_error(404)
        else:
            return file.read_bytes()
        return None

    def log_message(self, *_):
        pass


@pytest.fixture
def server(night_log, monkeypatch):
    """Return the address of a server that has the log of a night."""
    monkeypatch.setenv(SECRETS, "")
    handler = functools.partial(_Handler, directory=str(night_log.parent))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as serving:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        yield f"127.0.0.1:{serving.server_port}"
        serving.shutdown()


def epipole(*arguments):
    """Run a command, and return its exit code and all that it printed."""
    ended = CliRunner().invoke(app, [str(a) for a in arguments])
    if ended.exception is not None and not isinstance(ended.exception, SystemExit):
        raise ended.exception
    return ended.exit_code, ended.stderr + ended.stdout


def files_with(secret, *folders):
    """Return the files that have a secret."""
    found = []
    for folder in folders:
        for path in Path(folder).rglob("*"):
            if path.is_file() and secret.encode() in path.read_bytes():
                found.append(str(path))
    return found


@pytest.mark.long
def test_a_run_of_a_url_with_secrets_keeps_none_of_them(prefect, server, tmp_path, caplog):
    url = f"http://me:{PASSWORD}@{server}/night.mcap?token={TOKEN}"
    code, printed = epipole("run", url, "--out", tmp_path / "out")
    assert code == 0, printed
    code, again = epipole("run", url.replace(PASSWORD, PASSWORD + "2"), "--out", tmp_path / "out")
    assert "unchanged" in again
    folders = [tmp_path / "out", os.environ["PREFECT_HOME"], os.environ["EPIPOLE_CACHE"]]
    for secret in (PASSWORD, TOKEN):
        assert files_with(secret, *folders) == []
        assert secret not in printed + again + caplog.text
    assert files_with(f"http://{server}/night.mcap", os.environ["PREFECT_HOME"])  # it is searched


def test_no_message_has_the_secrets_of_a_url(server, no_early_server):
    at = f"http://me:{PASSWORD}@{server}"
    for url in (
        f"{at}/none.mcap?token={TOKEN}", f"{at}/night.mcap?token=wrong-{PASSWORD}",
        f"{at}/*.mcap?token={TOKEN}", f"http://me:{PASSWORD}@127.0.0.1:9/a.mcap?sig={TOKEN}",
        f"http://me:{PASSWORD}@[::1/a.mcap", f"s3://me:{PASSWORD}@/a.mcap",
        f"nothing://me:{PASSWORD}@host/a.mcap?{TOKEN}=",
    ):  # fmt: skip
        for command in (["info"], ["calibrate"], ["run", "--out", "out"], ["nights"]):
            code, printed = epipole(*command, url)
            assert code != 0
            assert PASSWORD not in printed
            assert TOKEN not in printed
            assert "epipole: " in printed


def test_a_url_without_a_bucket_is_refused_before_its_store_is_asked(no_early_server):
    code, printed = epipole("info", f"s3://me:{PASSWORD}@/a.mcap")
    assert code == 1
    assert "s3:///a.mcap: cannot be read: the URL has no bucket; write s3://BUCKET/PATH" in printed


def test_info_names_the_log_without_its_secrets(server):
    code, printed = epipole("info", "--json", f"http://x:{PASSWORD}@{server}/night.mcap?t={TOKEN}")
    assert code == 0, printed
    assert json.loads(printed[printed.index("[") :])[0]["log"] == f"http://{server}/night.mcap"


def test_keys_of_a_store_may_stand_in_the_url(s3, night_log, tmp_path, monkeypatch):
    s3.put_file(str(night_log), "logs/keys/night.mcap")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv(SECRETS, "")
    for _ in range(2):
        code, printed = epipole("info", "--json", f"s3://key:{PASSWORD}@logs/keys/night.mcap")
        assert code == 0, printed
        assert json.loads(printed[printed.index("[") :])[0]["log"] == "s3://logs/keys/night.mcap"


def test_urls_that_differ_in_secrets_only_are_refused(no_early_server):
    code, printed = epipole("run", "http://a:b@h/x.mcap", "http://a:c@h/x.mcap", "--out", "out")
    assert code == 1
    assert "differ only in their passwords or queries" in printed


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("http://u:p@h:8/x.mcap", "http://h:8/x.mcap"),
        ("http://u:p w@h/x.mcap", "http://h/x.mcap"),
        ("http://token@h/x.mcap", "http://h/x.mcap"),
        ("s3://k:s@b/x.mcap", "s3://b/x.mcap"),
        ("https://h/x.mcap?X-Amz-Signature=s&versionId=3", "https://h/x.mcap?versionId=3"),
        ("https://h/get?file=x.mcap&sig=s", "https://h/get?file=x.mcap"),
        ("https://h/x#access_token=s", "https://h/x"),
        ("cannot open 'http://u:p@h/x?t=s': no", "cannot open 'http://h/x': no"),
        ("a http://u:p@h/x?t=s, b http://u:p@h/y?t=s.", "a http://h/x, b http://h/y."),
        ("--known=http://u:p@h/x?t=s", "--known=http://h/x"),
        ("s3://b/night-?.mcap", "s3://b/night-?.mcap"),
        ("s3://b/a@2.mcap", "s3://b/a@2.mcap"),
        ("me@host: no URL?a=b", "me@host: no URL?a=b"),
    ],
)
def test_a_text_is_shown_without_the_secrets_of_its_urls(text, shown):
    assert without_secrets(text) == shown
    assert without_secrets(shown) == shown
    assert line_of(ValueError(text)) == shown


def test_a_rotated_password_takes_the_place_of_the_one_before(monkeypatch):
    monkeypatch.setenv(SECRETS, "")
    assert known_as("http://u:old@h/x") == known_as("http://u:new@h/x") == "http://h/x"
    assert "old" not in os.environ[SECRETS]


def test_processes_can_be_started_whatever_the_number_of_signed_urls(monkeypatch):
    monkeypatch.setattr(os, "environ", os.environ.copy())
    os.environ[SECRETS] = ""
    urls = [f"https://h/{k}.mcap?signature={k:0700}" for k in range(500)]
    for url in urls:
        known_as(url)
    for url in urls[::100]:
        assert _with_secrets(without_secrets(url)) == url
    known_as("https://h/0.mcap?signature=new")
    assert _with_secrets("https://h/0.mcap") == "https://h/0.mcap?signature=new"
    command = "from epipole.io.paths import _with_secrets as w; print(w('https://h/499.mcap'))"
    run = [sys.executable, "-c", command]
    assert subprocess.check_output(run, env=os.environ, text=True).strip() == urls[-1]
