"""Recording of live messages as they arrive, in files that are readable whenever the program ends."""

import asyncio
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Literal

from mcap.writer import CompressionType, Writer
from rosbags.convert.converter import is_same_wireformat
from rosbags.typesys.store import Typestore

from calgraph.config.settings import LimitSettings, RecorderSettings
from calgraph.errors import InputError, RecordingError
from calgraph.io.termination import add_cleanup, remove_cleanup
from calgraph.live.recorded_files import finish_files, name_next_file, name_part, read_files, sync_folder
from calgraph.live.source import Channel, LiveMessage
from calgraph.live.state import RecorderState
from calgraph.recording.bag_files import METADATA, write_metadata
from calgraph.recording.damage import LimitedStore
from calgraph.recording.message_types import MessageType, make_message_type, ros2_definition
from calgraph.recording.unfinished_mcap import finish_mcap

_HEADER = "std_msgs/msg/Header"


@dataclass(frozen=True)
class CdrSchema:
    """How messages of a channel are recorded."""

    encoding: Literal["ros2msg", "ros2idl"]
    """The language of the definitions."""
    text: str
    convert: Callable[[bytes], bytes]
    """A message of the channel to CDR; raises what rosbags does where it does not fit its definition."""


def make_cdr_schema(channel: Channel) -> CdrSchema:
    """The definitions and the conversion for a channel; without one for CDR.

    Messages of ROS 1 become those of ROS 2 of the same name where the fields have the same types, and keep their
    definition otherwise. Headers lose ``seq``, which those of ROS 2 do not have.

    Raises:
        ValueError: the definition of a type of ROS 1 is unknown.
    """
    if channel.encoding == "cdr":
        idl = channel.schema_format == "ros2idl"
        return CdrSchema("ros2idl" if idl else "ros2msg", channel.schema, bytes)
    source = channel.message_type
    if source.store is None:
        raise ValueError(f"the definition of type {channel.type} is unknown")
    store = _find_ros2_store(source, source.store)
    text, _ = store.generate_msgdef(channel.type, ros_version=2)
    return CdrSchema("ros2msg", text, partial(_convert, source, store))


def _find_ros2_store(source: MessageType, store: Typestore) -> Typestore:
    """The types of ROS 2 that a type of ROS 1 is converted to."""
    same = ros2_definition(source.name)
    target = make_message_type(same).store if same else None
    if target is not None and is_same_wireformat(store, target, source.name, source.name):
        return target
    header = ros2_definition(_HEADER)
    assert header is not None
    headers = make_message_type(header).store
    assert headers is not None
    converted = LimitedStore()
    converted.register({**store.fielddefs, _HEADER: headers.fielddefs[_HEADER]})
    return converted


def _convert(source: MessageType, store: Typestore, raw: bytes) -> bytes:
    # The conversion follows the lengths in a message without limits, which this checks.
    source.deserialize(raw)
    return bytes(store.ros1_to_cdr(raw, source.name))


# Chunks end when they are flushed, and not before.
_NO_LIMIT = 2**62
# Times of arrival are signed numbers of 64 bits.
_MAX_TIME = 2**63
# Writing what is queued takes less where a signal ends the program, s; the cleanup of everything has ten.
_MAX_CLOSING_TIME = 8.0


# Size above which a chunk is written earlier, 4.2 MB: readers unpack a whole chunk for one message.
_MAX_CHUNK_BYTES = 2**22
# Time over which the rate is averaged that predicts when the disk is full, s: images vary over seconds.
_RATE_WINDOW = 30.0


class Recorder:
    """Writes messages into the next file of a rosbag2 folder: ``recording_0.mcap``, ``recording_1.mcap``, ...

    A thread writes them, as chunks that are complete in the file at most ``max_chunk_duration`` after the first of
    their messages. Chunks are not compressed: images mostly are, and processors have the board to detect.

    Args:
        folder: of the recording; it is created. Its metadata.yaml is removed until the recorder is closed, and
            files of recorders that were killed are finished.
        settings: of the recorder.
        limits: ``min_free_disk`` is kept free.

    Raises:
        InputError: the folder cannot be written to, or its disk is almost full.
    """

    def __init__(self, folder: Path, settings: RecorderSettings, limits: LimitSettings) -> None:
        self._folder, self._settings, self._limits = folder, settings, limits
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if shutil.disk_usage(folder).free < limits.min_free_disk:
                raise InputError(f"{folder}: {self._describe_full_disk()}")
            (folder / METADATA).unlink(missing_ok=True)
            finish_files(folder, limits)
            self.path = name_next_file(folder)
            self._file = name_part(self.path).open("xb")
        except OSError as error:
            raise InputError(f"{folder}: cannot be written to ({error.strerror or error})") from error
        self._writer = Writer(self._file, chunk_size=_NO_LIMIT, compression=CompressionType.NONE)
        self._writer.start("ros2")
        self._channels: dict[Channel, tuple[int, CdrSchema] | str] = {}
        """Number and schema of each channel, or why its messages cannot be recorded."""
        self._queue: SimpleQueue[LiveMessage | None] = SimpleQueue()
        self._queued_bytes = self._done_bytes = 0
        """Of all messages; the former are counted by the event loop, the latter by the thread."""
        self._count = 0
        self._arrivals: tuple[int, int] | None = None
        """The first and the last in the file, ns."""
        self._refused: dict[str, tuple[int, str]] = {}
        """By topic: how many messages cannot be recorded, and why the first one cannot."""
        self._failure = ""
        """Why the recording has ended."""
        self._ending = threading.Lock()
        """No message is queued while the recording ends: what was accepted before is written."""
        self._sizes: deque[tuple[float, int]] = deque([(time.monotonic(), 0)])
        """When, s, the file had which size, bytes: within the window of the rate."""
        self._sync_time = time.monotonic()
        self._state = RecorderState()
        self._has_space = asyncio.Event()
        self._wake: Callable[[], object] = bool
        """Has the event loop look for space in the queue again."""
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()
        add_cleanup(self, self._close_at_once)

    @property
    def state(self) -> RecorderState:
        """What is in the file."""
        return self._state

    async def write(self, message: LiveMessage) -> None:
        """Queues a message; waits while ``max_queued_bytes`` wait for the disk.

        Raises:
            RecordingError: the recording has ended, and why: the disk is almost full, or cannot be written to.
        """
        loop = asyncio.get_running_loop()
        self._wake = lambda: loop.call_soon_threadsafe(self._has_space.set)
        while self._is_full():
            self._has_space.clear()
            if self._is_full():  # the thread may have written in between
                await self._has_space.wait()
        with self._ending:
            if self._failure:
                raise RecordingError(self._failure)
            self._queued_bytes += len(message.data)
            self._queue.put(message)

    async def close(self) -> None:
        """Writes what is queued, the index of the file, and metadata.yaml.

        Raises:
            RecordingError: not everything could be written, and why.
        """
        self._queue.put(None)
        await asyncio.to_thread(self._thread.join)
        remove_cleanup(self)
        if self._failure:
            raise RecordingError(self._failure)

    def _close_at_once(self) -> None:
        self._queue.put(None)
        self._thread.join(_MAX_CLOSING_TIME)

    def _is_full(self) -> bool:
        return self._queued_bytes - self._done_bytes > self._settings.max_queued_bytes and not self._failure

    def _run(self) -> None:
        try:
            self._record()
            self._writer.finish()  # type: ignore[no-untyped-call]
            if self._count:
                self._file.flush()
                os.fsync(self._file.fileno())
        except Exception as error:  # without this thread messages would only be queued
            reason = getattr(error, "strerror", None) or error
            self._fail(f"cannot be written to ({reason}): the recording has ended")
        # What follows is of use to the tools of ROS 2; calgraph reads the files without.
        with suppress(OSError):  # what could not be written is tried again
            self._file.close()
        with suppress(Exception):
            name_part(self.path).unlink(missing_ok=True)
            finish_mcap(self.path, self._limits)
        with suppress(Exception):
            write_metadata(self._folder, read_files(self._folder, self._limits))

    def _record(self) -> None:
        """Writes messages until the recorder is closed, or the disk is almost full.

        Raises:
            OSError: the file cannot be written to.
        """
        pending, pending_bytes, deadline = 0, 0, 0.0
        # Those who wait for space in the queue wait for the end of the chunk.
        max_bytes = min(_MAX_CHUNK_BYTES, self._settings.max_queued_bytes)
        while True:
            wait = max(0.0, deadline - time.monotonic()) if pending else None
            try:
                message = self._queue.get(timeout=0.0 if self._failure else wait)
            except Empty:
                if self._failure:
                    self._flush(pending_bytes)
                    return
                is_due = True
            else:
                if message is None:
                    self._flush(pending_bytes)
                    return
                if not pending:
                    deadline = time.monotonic() + self._settings.max_chunk_duration
                self._add(message)
                pending += 1
                pending_bytes += len(message.data)
                is_due = pending_bytes >= max_bytes or time.monotonic() >= deadline
            if is_due:
                self._flush(pending_bytes)
                pending = pending_bytes = 0

    def _add(self, message: LiveMessage) -> None:
        """Adds a message to the chunk; one that cannot be recorded is counted."""
        channel = message.channel
        if channel not in self._channels:
            self._channels[channel] = self._add_channel(channel)
        registered = self._channels[channel]
        if isinstance(registered, str):
            self._refuse(channel.topic, registered)
            return
        number, schema = registered
        try:
            data = schema.convert(message.data)
        except Exception as error:  # parsers of damaged bytes raise many kinds
            self._refuse(channel.topic, " ".join(str(error).split()))
            return
        if not 0 <= message.arrival < _MAX_TIME:
            self._refuse(channel.topic, f"it arrived at {message.arrival} ns, which is no time")
            return
        self._writer.add_message(number, message.arrival, data, message.arrival)
        first, last = self._arrivals or (message.arrival, message.arrival)
        self._arrivals = min(first, message.arrival), max(last, message.arrival)
        self._count += 1

    def _add_channel(self, channel: Channel) -> tuple[int, CdrSchema] | str:
        try:
            schema = make_cdr_schema(channel)
            definitions = schema.text.encode()
            # The writer encodes names, and keeps those that it cannot encode.
            (channel.type + channel.topic).encode()
        except Exception as error:  # as above
            return " ".join(str(error).split())
        number = self._writer.register_schema(channel.type, schema.encoding, definitions)
        return self._writer.register_channel(channel.topic, "cdr", number, {"offered_qos_profiles": ""}), schema

    def _refuse(self, topic: str, reason: str) -> None:
        count, first_reason = self._refused.get(topic, (0, reason))
        self._refused[topic] = count + 1, first_reason

    def _flush(self, pending_bytes: int) -> None:
        """Writes the chunk, and updates the state.

        Raises:
            OSError: it cannot be written.
        """
        if self._count:
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._file.flush()
            if not self._state.messages:
                name_part(self.path).rename(self.path)
                sync_folder(self._folder)
        now = time.monotonic()
        if self._settings.sync_period and now - self._sync_time > self._settings.sync_period:
            os.fsync(self._file.fileno())
            self._sync_time = now
        free = shutil.disk_usage(self._folder).free
        self._update_state(now, free)
        if free < self._limits.min_free_disk and not self._failure:
            self._fail(f"{self._describe_full_disk()}: the recording has ended")
        self._done_bytes += pending_bytes
        self._wake()

    def _update_state(self, now: float, free: int) -> None:
        size = self._file.tell()
        self._sizes.append((now, size))
        while now - self._sizes[0][0] > _RATE_WINDOW:
            self._sizes.popleft()
        began, size_then = self._sizes[0]
        rate = (size - size_then) / (now - began) if now > began else 0.0
        first, last = self._arrivals or (0, 0)
        self._state = RecorderState(
            seconds=(last - first) / 1e9,
            megabytes=size / 1e6,
            messages=self._count,
            minutes_left=max(0, free - self._limits.min_free_disk) / rate / 60 if rate else None,
            problem=self._failure or self._describe_refused(),
        )

    def _describe_refused(self) -> str:
        return "; ".join(
            f"{topic}: {count} message{'s' if count > 1 else ''} not recorded: {reason}"
            for topic, (count, reason) in self._refused.items()
        )

    def _describe_full_disk(self) -> str:
        return (
            f"its disk is almost full: {self._limits.min_free_disk / 1e6:.0f} MB are kept free "
            "(limits.min_free_disk); remove other files"
        )

    def _fail(self, reason: str) -> None:
        """Ends the recording with an error."""
        with self._ending:
            self._failure = f"{self.path}: {reason}"
        self._state = replace(self._state, problem=self._failure)
        self._wake()
