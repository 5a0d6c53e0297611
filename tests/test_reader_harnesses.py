"""Every reader answers damaged input by a value or an error of calgraph: what the fuzzer checks, on few inputs."""

from pathlib import Path
from random import Random

import pytest

from fuzz_readers import Monitor
from reader_harnesses import HARNESSES, Harness

pytestmark = pytest.mark.slow

# Of each reader; the fuzzer tries thousands a second, guided by coverage.
DAMAGED = 25


def damage(data: bytes, rng: Random) -> bytes:
    """A few bytes changed, removed or repeated."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        i = rng.randrange(len(changed) + 1)
        length = rng.choice((1, 1, 2, 8, 64))
        changed[i : i + length] = rng.choice(
            (b"", rng.randbytes(length), b"\xff" * length, changed[i:] + changed[:8])
        )
    return bytes(changed)


@pytest.mark.parametrize("name", HARNESSES)
def test_a_reader_answers_damaged_input(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    rng, monitor = Random(1), Monitor(name, tmp_path / "findings", scratch)
    seeds = monitor.harness.seeds()
    for seed in seeds:
        monitor.run(seed)
    assert monitor.refused < len(seeds), "no seed is valid: mutations will not reach far"
    for _ in range(DAMAGED):
        seed = rng.choice(seeds)
        if monitor.harness.mutate and rng.random() < 0.7:
            monitor.run(monitor.harness.mutate(seed, rng, lambda part: damage(part, rng)))
        else:
            monitor.run(damage(seed, rng))
    assert monitor.count == len(seeds) + DAMAGED
    findings = [path.read_text(encoding="utf-8") for path in (tmp_path / "findings").glob("*.txt")]
    assert not findings, findings[0]


def test_a_finding_is_kept_with_its_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monitor = Monitor("PCD", tmp_path / "findings", tmp_path / "scratch")

    def broken(data: bytes, _: Path) -> None:
        if len(data) > 3:
            raise IndexError("out of range")

    monkeypatch.setattr(monitor, "harness", Harness(broken, list))
    monitor.scratch.mkdir()
    for data in (b"123", b"123456", b"1234", b"12345"):
        monitor.run(data)
    [kept] = (tmp_path / "findings").glob("*.bin")
    assert kept.read_bytes() == b"1234"
    assert "IndexError: out of range" in kept.with_suffix(".txt").read_text(encoding="utf-8")
