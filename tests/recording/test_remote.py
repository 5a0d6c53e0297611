"""Recordings at URLs, served by programs of this machine."""

import os
import socket
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import boto3
import pytest
from moto.server import ThreadedMotoServer

from calgraph.config.settings import LimitSettings
from calgraph.errors import InputError, RecordingError
from calgraph.recording import RecordingWriter, open_recordings, remote
from calgraph.sensors import Trigger

QUICK = LimitSettings(url_timeout=2.0, min_free_disk=0)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rosbag2 folder with one MCAP."""
    path = tmp_path_factory.mktemp("written") / "recording"
    with RecordingWriter(path) as writer:
        for stamp in (1.0, 2.0, 3.0):
            writer.write("/trigger", Trigger(stamp))
    return path


@pytest.fixture(autouse=True)
def _own_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


@pytest.fixture(scope="module")
def store(recording: Path) -> Iterator[str]:
    """The address of an S3-compatible store with the recording in the bucket ``fleet``."""
    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    address = f"http://{host}:{port}"
    client = boto3.client(
        "s3", endpoint_url=address, region_name="us-east-1", aws_access_key_id="a", aws_secret_access_key="b"
    )
    client.create_bucket(Bucket="fleet")
    for file in recording.iterdir():
        client.upload_file(str(file), "fleet", f"robot 7/recording/{file.name}")
    client.close()
    yield address
    server.stop()


@pytest.fixture
def _credentials(store: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for variable, value in {
        "AWS_ENDPOINT_URL": store,
        "AWS_ACCESS_KEY_ID": "a",
        "AWS_SECRET_ACCESS_KEY": "b",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_CONFIG_FILE": str(tmp_path / "none"),
        "AWS_SHARED_CREDENTIALS_FILE": str(tmp_path / "none"),
        "AWS_EC2_METADATA_DISABLED": "true",
    }.items():
        monkeypatch.setenv(variable, value)


def read_stamps(url: str, limits: LimitSettings = QUICK) -> list[float]:
    with open_recordings([url], limits) as opened:
        assert opened.opened_from == (url,)
        return [record.stamp for record in opened.records()]


@pytest.mark.usefixtures("_credentials")
@pytest.mark.parametrize("path", ["recording", "recording/", "recording/recording.mcap"])
def test_a_file_or_folder_of_a_bucket_is_a_recording(path: str) -> None:
    assert read_stamps(f"s3://fleet/robot 7/{path}") == [1.0, 2.0, 3.0]


@pytest.mark.usefixtures("_credentials")
def test_a_copy_serves_until_the_file_changes(recording: Path, store: str, tmp_path: Path) -> None:
    url = "s3://fleet/changing.mcap"
    client = boto3.client("s3", endpoint_url=store)
    client.upload_file(str(recording / "recording.mcap"), "fleet", "changing.mcap")
    assert read_stamps(url) == read_stamps(url) == [1.0, 2.0, 3.0]
    assert len(list(tmp_path.rglob("changing.mcap"))) == 1
    with RecordingWriter(tmp_path / "longer") as writer:
        writer.write("/trigger", Trigger(7.0))
    (longer,) = (tmp_path / "longer").glob("*.mcap")
    client.upload_file(str(longer), "fleet", "changing.mcap")
    client.close()
    assert read_stamps(url) == [7.0]
    copy = remote.find_copy(url)
    assert copy is not None
    assert copy.read_bytes() == longer.read_bytes()


@pytest.mark.usefixtures("_credentials")
def test_copies_that_are_not_used_are_removed(tmp_path: Path) -> None:
    read_stamps("s3://fleet/robot 7/recording")
    (used,) = tmp_path.glob("calgraph-recordings-*/*/*/used")
    os.utime(used, (0, 0))
    read_stamps("s3://fleet/robot 7/recording/recording.mcap")
    assert not used.parent.exists()


@pytest.mark.usefixtures("_credentials")
@pytest.mark.parametrize("url", ["s3://fleet/none.mcap", "s3://elsewhere/recording.mcap"])
def test_what_a_store_does_not_have_is_named(url: str) -> None:
    with pytest.raises(InputError, match=f"^{url}: does not exist"):
        read_stamps(url)


@pytest.mark.usefixtures("_credentials")
def test_missing_credentials_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    with pytest.raises(RecordingError, match=r"cannot be read \(.*credentials.*\); check address, network"):
        read_stamps("s3://fleet/robot 7/recording")


def test_a_store_that_is_not_there_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{silent.getsockname()[1]}")
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", "a")
        monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "b")
        monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
        with pytest.raises(RecordingError, match=r"s3://fleet/a.mcap: cannot be read \(.*127\.0\.0\.1"):
            read_stamps("s3://fleet/a.mcap")


class QuietHandler(SimpleHTTPRequestHandler):
    """Serves files, and logs nothing."""

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def site(recording: Path) -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(QuietHandler, directory=str(recording))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_a_file_of_a_web_server_is_a_recording(site: str) -> None:
    assert read_stamps(f"{site}/recording.mcap?token=1") == [1.0, 2.0, 3.0]
    with pytest.raises(InputError, match=r"none\.mcap: does not exist"):
        read_stamps(f"{site}/none.mcap")


def test_a_file_url_is_read_where_it_is(recording: Path, tmp_path: Path) -> None:
    assert read_stamps(f"file://{recording}") == [1.0, 2.0, 3.0]
    assert list(tmp_path.iterdir()) == []


def test_a_copy_leaves_space_on_the_disk(site: str) -> None:
    with pytest.raises(RecordingError, match=r"more than the space in .* \(limits\.min_free_disk\); set TMPDIR"):
        read_stamps(f"{site}/recording.mcap", LimitSettings(min_free_disk=2**60))


def test_an_unknown_protocol_is_refused() -> None:
    with pytest.raises(RecordingError, match=r"^carrier://pigeon: cannot be read \(Protocol not known: carrier"):
        read_stamps("carrier://pigeon")
