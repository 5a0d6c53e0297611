"""ROS 2 on the loopback interface as a live source."""

import asyncio
import os
from typing import Any

import pytest

from calgraph.config.settings import ConnectionSettings, Settings
from calgraph.errors import InputError
from calgraph.live.dds import DdsSource, dds_topic_name, make_dds_type, ros_type_name
from calgraph.live.open_source import open_source
from calgraph.live.source import LiveMessage, Notice
from collected_sources import messages, notices
from foxglove_servers import HEADER, ROS2, until

pytestmark = pytest.mark.slow

pytest.importorskip("cyclonedds", reason="cyclonedds has no wheel for this Python")

LOOPBACK = """<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast><Interfaces><NetworkInterface
name="lo" multicast="false"/></Interfaces></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>50</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain>
</CycloneDDS>"""
FAST = ConnectionSettings(discovery_time=0.3, notice_interval=0)


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """A domain that no other test process uses, on the loopback interface."""
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    return 100 + os.getpid() % 100


def make_writer(domain: int, topic: str, *, reliable: bool) -> tuple[Any, Any]:
    """A publisher of headers, and the type of what it writes."""
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    header = make_dds_type(HEADER)
    quality = Qos(
        Policy.Reliability.Reliable(10**9) if reliable else Policy.Reliability.BestEffort,
        Policy.History.KeepLast(50),
    )
    participant = DomainParticipant(domain)
    return DataWriter(participant, Topic(participant, topic, header), qos=quality), header


@pytest.mark.parametrize("reliable", [True, False])
def test_messages_arrive_as_ros_serialises_them(domain: int, reliable: bool) -> None:
    writer, header = make_writer(domain, "rt/robot/trigger", reliable=reliable)

    async def run() -> list[LiveMessage | Notice]:
        source = open_source(f"ros2://{domain}/robot", Settings())
        enough = lambda given: len(messages(given)) >= 5  # noqa: E731
        received = asyncio.create_task(until(source, ["/trigger"], enough))
        async with asyncio.timeout(60):
            while not writer.get_matched_subscriptions():
                await asyncio.sleep(0.01)
            k = 0
            while not received.done():
                writer.write(header(make_dds_type("builtin_interfaces/msg/Time")(k, 5), "laser"))
                k += 1
                await asyncio.sleep(0.01)
        return await received

    given = messages(asyncio.run(run()))
    assert {one.channel.topic for one in given} == {"/trigger"}
    described = given[0].channel
    assert (described.type, described.encoding, described.schema_format) == (HEADER, "cdr", "ros2msg")
    contents: list[Any] = [ROS2.deserialize_cdr(one.data, HEADER) for one in given]
    assert [one.stamp.sec - contents[0].stamp.sec for one in contents[:5]] == list(range(5))
    assert contents[0].frame_id == "laser"


def test_a_topic_that_nothing_publishes_is_missing(domain: int) -> None:
    found = lambda given: any(one.kind == "missing" for one in notices(given))  # noqa: E731
    given = asyncio.run(until(DdsSource(f"ros2://{domain}", FAST), ["/scan"], found))
    (missing,) = [one for one in notices(given) if one.kind == "missing"]
    assert missing.topic == "/scan"
    assert f"nothing publishes it in domain {domain}" in missing.text


@pytest.mark.parametrize(
    "name", ["Image", "CompressedImage", "CameraInfo", "LaserScan", "MultiEchoLaserScan", "PointCloud2", "Imu"]
)
def test_types_of_sensors_have_the_names_that_ros_gives_them(name: str) -> None:
    made = make_dds_type(f"sensor_msgs/msg/{name}")
    dds_name = made.__idl__.idl_transformed_typename.replace(".", "::")
    assert dds_name == f"sensor_msgs::msg::dds_::{name}_"
    assert ros_type_name(dds_name) == f"sensor_msgs/msg/{name}"


def test_names_of_topics_are_those_of_ros() -> None:
    assert dds_topic_name("/camera/image") == "rt/camera/image"
    assert dds_topic_name("/scan", "robot_1/") == "rt/robot_1/scan"
    assert ros_type_name("DDS::Something") is None


@pytest.mark.parametrize("address", ["ros2://233", "ros2:7", "ros2://a/b", "ros2://0/a b"])
def test_a_malformed_address_is_refused(address: str) -> None:
    with pytest.raises(InputError, match="give ros2: or ros2://DOMAIN/NAMESPACE"):
        open_source(address, Settings())
