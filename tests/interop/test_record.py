"""`tcvae record` with real rclpy: what is published is in the file, as Python's readers of bags see it."""

import ast
import json
import signal
import threading
import time

import pytest
from conftest import ROOT
from geometry_msgs.msg import PointStamped, PoseStamped, TransformStamped, WrenchStamped
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Empty, Float64, String, UInt16
from tf2_msgs.msg import TFMessage

BAXTER = [f"left_{joint}" for joint in ("s0", "s1", "e0", "e1", "w0", "w1", "w2")]
FINGER = "l_gripper_l_finger_joint"
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def joint_state(client, count, names=(*BAXTER, FINGER)):
    """The joint states of message number `count`; no two are alike."""
    message = JointState(name=list(names))
    message.header.stamp = client.node.get_clock().now().to_msg()
    message.position = [0.001 * count + joint for joint in range(len(names))]
    message.velocity = [-0.5 * count] * len(names)
    return message


def matched(publisher, process):
    """Waits until the recorder listens to a publisher, and knows it."""
    end = time.monotonic() + 10
    while publisher.get_subscription_count() == 0:
        assert time.monotonic() < end, f"nobody listens to {publisher.topic_name}"
        time.sleep(0.01)
    process.wait_for(f"{publisher.topic_name}: ")
    time.sleep(0.2)


def publish(publisher, messages, rate_hz=100):
    """Publishes at a rate, on average."""
    began = time.monotonic()
    for number, message in enumerate(messages):
        time.sleep(max(0.0, began + number / rate_hz - time.monotonic()))
        publisher.publish(message)
    return messages


@pytest.fixture
def record(start, tmp_path):
    """Starts `tcvae record -o tmp_path/one.mcap --json ...` and waits until it listens."""

    def record(*arguments, wait=True, **environment):
        output = ("-o", str(tmp_path / "one.mcap"))
        process = start("tcvae", "record", *output, "--json", *map(str, arguments), **environment)
        if wait:
            process.wait_for("listening to")
        return process

    return record


def end(process, number=signal.SIGTERM):
    """Ends a recording: its answer."""
    time.sleep(0.3)  # what was sent last is on its way
    process.signal(number)
    return answer(process)


def answer(process, timeout=10.0):
    assert process.wait(timeout) == 0, process.output
    return json.loads(process.output[process.output.index("{\n"):])


def raw(path):
    """The messages of each topic in a file, as bytes, in the order of their receipt."""
    found = {}
    with open(path, "rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            found.setdefault(channel.topic, []).append(message)
    return found


def messages(path, topic, kind):
    return [deserialize_message(message.data, kind) for message in raw(path)[topic]]


def test_every_message_is_in_the_file_as_three_readers_see_it(record, client, tmp_path):
    process = record()
    publisher = client.node.create_publisher(JointState, "/joint_states", 10)
    matched(publisher, process)
    sent = publish(publisher, [joint_state(client, n) for n in range(300)])
    found = end(process)
    path = tmp_path / "one.mcap"
    assert [file.name for file in tmp_path.iterdir()] == ["one.mcap"]

    assert messages(path, "/joint_states", JointState) == sent
    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        header, summary = reader.get_header(), reader.get_summary()
        assert header.profile == "ros2" and header.library.startswith("tcvae ")
        assert summary.statistics.message_count == 300
        assert [(s.name, s.encoding) for s in summary.schemas.values()] == [
            ("sensor_msgs/msg/JointState", "ros2msg")
        ]
    # By the definition in the file alone, as Foxglove decodes it.
    with open(path, "rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = [message.decoded_message for message in reader.iter_decoded_messages()]
    assert [list(m.position) for m in decoded] == [list(m.position) for m in sent]
    assert [m.header.stamp.nanosec for m in decoded] == [m.header.stamp.nanosec for m in sent]
    with AnyReader([path]) as reader:
        [connection] = reader.connections
        assert connection.topic == "/joint_states" and connection.msgcount == 300
        read = [reader.deserialize(data, connection.msgtype) for _, _, data in reader.messages()]
    assert [m.name for m in read] == [m.name for m in sent]
    assert [m.velocity.tolist() for m in read] == [list(m.velocity) for m in sent]

    for message, original in zip(raw(path)["/joint_states"], sent):
        assert 0 <= message.log_time - message.publish_time < 0.2e9
    times = [message.publish_time for message in raw(path)["/joint_states"]]
    assert abs((times[-1] - times[0]) / 1e9 - 2.99) < 0.2
    assert found["messages"] == 300 and found["dropped"] == 0
    assert found["joints"] == sorted([*BAXTER, FINGER]) and found["missing_joints"] == []
    assert abs(found["seconds"] - 2.99) < 0.2


def test_several_publishers_of_every_kind_are_heard(record, client, make_client, tmp_path):
    robot = tmp_path / "robot.toml"
    robot.write_text(ROBOT_WITH_GRIPPER_TOPIC)
    mark = client.node.create_publisher(String, "/mark", LATCHED)
    mark.publish(String(data="before anybody listened"))
    # One of these sends again what was lost, the other does not.
    arm = client.node.create_publisher(JointState, "/joint_states", 10)
    other = make_client("other")
    rest = other.node.create_publisher(JointState, "/joint_states", qos_profile_sensor_data)
    hand = other.node.create_publisher(Float64, "/hand/opening", qos_profile_sensor_data)
    process = record("--robot", robot, "--topic", "/mark")
    for publisher in (mark, arm, rest, hand):
        matched(publisher, process)
    sent = {
        arm: [joint_state(client, n, BAXTER[:4]) for n in range(200)],
        rest: [joint_state(client, n, BAXTER[4:]) for n in range(200)],
        hand: [Float64(data=float(n)) for n in range(200)],
    }
    threads = [threading.Thread(target=publish, args=item) for item in sent.items()]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    mark.publish(String(data="at the end"))
    found = end(process)
    path = tmp_path / "one.mcap"
    joints = messages(path, "/joint_states", JointState)
    assert [m for m in joints if m.name == BAXTER[:4]] == sent[arm]
    assert [m for m in joints if m.name == BAXTER[4:]] == sent[rest]
    assert len(joints) == 400
    assert messages(path, "/hand/opening", Float64) == sent[hand]
    marks = messages(path, "/mark", String)
    assert [m.data for m in marks] == ["before anybody listened", "at the end"]
    assert found["dropped"] == 0 and found["missing_joints"] == []
    counts = {topic["name"]: topic["messages"] for topic in found["topics"]}
    assert counts == {"/joint_states": 400, "/hand/opening": 200, "/mark": 2}
    # `ros2 bag play` offers a topic again as it was offered.
    with AnyReader([path]) as reader:
        profiles = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
    assert [p.durability.name for p in profiles["/mark"]] == ["TRANSIENT_LOCAL"]
    assert {p.reliability.name for p in profiles["/joint_states"]} == {"RELIABLE", "BEST_EFFORT"}


# Baxter's left arm, whose gripper says on a topic how far it is open.
ROBOT_WITH_GRIPPER_TOPIC = """
name = "baxter"
base_frame = "base"
tip_link = "left_gripper"
[arm]
name = "left"
joints = ["left_s0", "left_s1", "left_e0", "left_e1", "left_w0", "left_w1", "left_w2"]
gripper = "left_gripper"
gripper_source = { topic = "/hand/opening", closed = 0.0, open = 100.0 }
"""


def some_of_each_type():
    """Messages of every type that the program has a definition of."""
    point, pose, transform = PointStamped(), PoseStamped(), TransformStamped()
    point.header.frame_id, point.point.z = "base", 0.25
    pose.pose.position.x, pose.pose.orientation.w = 1.5, 0.5
    transform.child_frame_id, transform.transform.translation.y = "tip", -2.0
    wrench = WrenchStamped()
    wrench.wrench.torque.z = 3.5
    return {
        "/point": (point, lambda m: (m.header.frame_id, m.point.z)),
        "/pose": (pose, lambda m: (m.pose.position.x, m.pose.orientation.w)),
        "/transform": (transform, lambda m: (m.child_frame_id, m.transform.translation.y)),
        "/tree": (TFMessage(transforms=[transform] * 2), lambda m: m.transforms[1].child_frame_id),
        "/wrench": (wrench, lambda m: m.wrench.torque.z),
        "/bool": (Bool(data=True), lambda m: m.data),
        "/number": (UInt16(data=513), lambda m: m.data),
        "/text": (String(data="äöü"), lambda m: m.data),
        "/nothing": (Empty(), lambda m: ()),
    }


def test_what_a_task_needs_to_hear_of_is_recorded_too(record, client, tmp_path):
    task = tmp_path / "task.toml"
    task.write_text(f"""based_on = "{ROOT / 'config/tasks/pour.toml'}"
[[locations]]
name = "pour_location"
at = "action"
topic = "/bowl"
[[locations]]
name = "source_cup"
at = "start"
[recording]
cut_at = {{ marker = "/next" }}
""")
    process = record("--task", task)
    arm = client.node.create_publisher(JointState, "/joint_states", 10)
    bowl = client.node.create_publisher(PointStamped, "/bowl", 10)
    mark = client.node.create_publisher(Empty, "/next", 10)
    for publisher in (arm, bowl, mark):
        matched(publisher, process)
    publish(arm, [joint_state(client, n) for n in range(20)])
    bowl.publish(PointStamped())
    mark.publish(Empty())
    end(process)
    found = {topic: len(of) for topic, of in raw(tmp_path / "one.mcap").items()}
    assert found == {"/joint_states": 20, "/bowl": 1, "/next": 1}


def test_other_tools_decode_every_type_by_the_definition_in_the_file(record, client, tmp_path):
    sent = some_of_each_type()
    publishers = {
        topic: client.node.create_publisher(type(message), topic, 10)
        for topic, (message, _) in sent.items()
    }
    # One has its type named, as somebody does who starts the recorder first.
    topics = [topic.replace("/bool", "/bool:std_msgs/msg/Bool") for topic in sent]
    process = record(*[argument for topic in topics for argument in ("--topic", topic)])
    for topic, publisher in publishers.items():
        matched(publisher, process)
        publisher.publish(sent[topic][0])
    found = end(process)
    assert all(topic["has_definition"] for topic in found["topics"] if topic["messages"])
    path = tmp_path / "one.mcap"
    decoded = {}
    with open(path, "rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for message in reader.iter_decoded_messages():
            decoded[message.channel.topic] = message.decoded_message
    with AnyReader([path]) as reader:
        read = {c.topic: reader.deserialize(d, c.msgtype) for c, _, d in reader.messages()}
    for topic, (message, fields) in sent.items():
        assert fields(decoded[topic]) == fields(read[topic]) == fields(message), topic


def test_a_type_without_a_definition_is_recorded_and_told(record, client, tmp_path):
    from tcvae_msgs.msg import TaskLocation

    message = TaskLocation(name="source_cup")
    publisher = client.node.create_publisher(TaskLocation, "/own", 10)
    process = record("--topic", "/own", AMENT_PREFIX_PATH="")
    matched(publisher, process)
    publisher.publish(message)
    found = end(process)
    assert "no definition of tcvae_msgs/msg/TaskLocation" in process.output
    [own] = [topic for topic in found["topics"] if topic["name"] == "/own"]
    assert own["messages"] == 1 and not own["has_definition"]
    assert messages(tmp_path / "one.mcap", "/own", TaskLocation) == [message]
    types = get_typestore(Stores.LATEST)
    with AnyReader([tmp_path / "one.mcap"], default_typestore=types) as reader:
        assert [c.msgtype for c in reader.connections] == ["tcvae_msgs/msg/TaskLocation"]


def test_definitions_are_taken_from_a_sourced_installation(record, client, tmp_path):
    from tcvae_msgs.msg import TaskLocation

    share = tmp_path / "ros" / "share" / "tcvae_msgs" / "msg"
    share.mkdir(parents=True)
    (share / "TaskLocation.msg").write_text("string name\ngeometry_msgs/PointStamped point")
    publisher = client.node.create_publisher(TaskLocation, "/own", 10)
    prefixes = f"/nowhere:{tmp_path / 'ros'}"
    process = record("--topic", "/own", AMENT_PREFIX_PATH=prefixes)
    matched(publisher, process)
    publisher.publish(TaskLocation(name="source_cup"))
    end(process)
    with AnyReader([tmp_path / "one.mcap"]) as reader:
        [read] = [reader.deserialize(data, c.msgtype) for c, _, data in reader.messages()]
    assert read.name == "source_cup"


def test_what_is_played_again_gives_the_same_recording(record, start, client, tmp_path):
    process = record()
    publisher = client.node.create_publisher(JointState, "/joint_states", 10)
    matched(publisher, process)
    publish(publisher, [joint_state(client, n) for n in range(100)])
    end(process)
    first = [message.data for message in raw(tmp_path / "one.mcap")["/joint_states"]]

    again = tmp_path / "again.mcap"
    process = start("tcvae", "record", "-o", str(again), "--json", "--compression", "none")
    matched(publisher, process)
    publish(publisher, first)
    end(process, signal.SIGINT)
    assert [message.data for message in raw(again)["/joint_states"]] == first
    assert len(first) == 100


def test_a_recorder_that_is_killed_leaves_what_it_had_until_then(record, start, client, tmp_path):
    process = record()
    publisher = client.node.create_publisher(JointState, "/joint_states", 10)
    matched(publisher, process)
    publish(publisher, [joint_state(client, n) for n in range(350)])
    process.kill()
    assert [file.name for file in tmp_path.iterdir()] == ["one.partial.mcap"]

    inspect = start("tcvae", "inspect", str(tmp_path / "one.partial.mcap"), "--json")
    inspect.wait(30)
    [seen] = json.loads(inspect.output[inspect.output.index("{\n"):])["demonstrations"]
    # At most the last second is lost, and the message of the match was not counted on.
    assert seen["duration_secs"] > 2.0 and 90 < seen["rate_hz"] < 110

    # Nobody's work is overwritten by accident.
    process = record(wait=False)
    assert process.wait(10) == 2 and "one.partial.mcap" in process.output
    process = record("--force", "--messages", "5")
    publish(publisher, [joint_state(client, n) for n in range(100)])
    assert answer(process)["messages"] == 5
    assert [file.name for file in tmp_path.iterdir()] == ["one.mcap"]


def test_what_is_there_is_replaced_only_when_asked_for(record, tmp_path):
    path = tmp_path / "one.mcap"
    path.write_bytes(b"precious")
    process = record(wait=False)
    assert process.wait(10) == 2 and "--force" in process.output
    # And not when there is nothing to replace it with.
    process = record("--force", "--duration", "1")
    assert process.wait(10) == 3
    assert path.read_bytes() == b"precious" and len(list(tmp_path.iterdir())) == 1


def test_where_nothing_is_heard_there_is_no_file_and_a_hint(record, client, domain, tmp_path):
    process = record("--duration", "1")
    assert process.wait(10) == 3
    assert f"Domain {domain}, range LOCALHOST" in process.output
    assert list(tmp_path.iterdir()) == []
    # Somebody else may be there, under another name or with another type.
    client.node.create_publisher(JointState, "/left/joint_states", 10)
    client.node.create_publisher(Bool, "/joint_states", 10)
    process = record("--duration", "2")
    assert process.wait(10) == 3
    assert "/left/joint_states (sensor_msgs/msg/JointState)" in process.output
    assert "/joint_states is published as std_msgs/msg/Bool" in process.output
    assert list(tmp_path.iterdir()) == []


def test_joints_that_are_missing_and_silent_topics_are_warned_of(record, client, tmp_path):
    robot = tmp_path / "robot.toml"
    robot.write_text(ROBOT_WITH_GRIPPER_TOPIC)
    process = record("--robot", robot)
    publisher = client.node.create_publisher(JointState, "/joint_states", 10)
    matched(publisher, process)
    publish(publisher, [joint_state(client, n, BAXTER[:-1]) for n in range(600)])
    found = end(process)
    assert "the robot's left_w2 came in no joint states so far" in process.output
    assert "/hand/opening has no publisher so far" in process.output
    assert found["missing_joints"] == ["left_w2"]


def test_names_are_remapped_and_expanded_as_those_of_a_node(record, client, tmp_path):
    publisher = client.node.create_publisher(JointState, "/robot/state", 10)
    marker = client.node.create_publisher(Bool, "/lab/mark", 10)
    process = record(
        "--topic", "mark", "--ros-args", "-r", "/joint_states:=/robot/state", "-r", "__ns:=/lab"
    )
    matched(publisher, process)
    matched(marker, process)
    node = ("tcvae_record", "/lab")
    took = client.spin_until(lambda: node in client.node.get_node_names_and_namespaces(), 5)
    assert took is not None
    listeners = client.node.get_subscriptions_info_by_topic("/robot/state")
    assert [(one.node_name, one.node_namespace) for one in listeners] == [node]
    assert listeners[0].qos_profile.reliability == ReliabilityPolicy.RELIABLE
    publisher.publish(joint_state(client, 1))
    marker.publish(Bool(data=True))
    end(process)
    assert sorted(raw(tmp_path / "one.mcap")) == ["/lab/mark", "/robot/state"]


def test_bytes_are_those_that_were_sent(record, client, tmp_path):
    process = record("--messages", "20")
    publisher = client.node.create_publisher(JointState, "/joint_states", 10)
    matched(publisher, process)
    # rclpy fills the gaps for alignment with whatever is there, so that bytes are compared with bytes.
    sent = publish(publisher, [serialize_message(joint_state(client, n)) for n in range(20)])
    answer(process)
    recorded = raw(tmp_path / "one.mcap")["/joint_states"]
    assert [message.data for message in recorded] == sent
    assert [message.sequence for message in recorded] == list(range(1, 21))


def played(folder):
    """Joint states of a recording in the layout of MIME, with the fingers of both hands."""
    # Some lines of MIME are no frames, and some have Python's quotes.
    text = (folder / "joint_angles.txt").read_text()
    frames = [ast.literal_eval(line) for line in text.splitlines() if line.startswith("{")]
    fingers = {
        f"{hand}_gripper_l_finger_joint": (folder / f"{side}_gripper.txt").read_text().split()
        for hand, side in (("l", "left"), ("r", "right"))
    }
    for number, angles in enumerate(frames):
        # The grippers have a rate of their own.
        for name, values in fingers.items():
            angles[name] = 0.000208 * float(values[number * len(values) // len(frames)])
        yield JointState(name=list(angles), position=list(angles.values()))


def test_training_goes_on_from_what_was_recorded_live(start, client, tmp_path):
    output = ("-o", str(tmp_path / "sim"))
    simulate = start("tcvae", "simulate", "pouring", "--seed", "1", "--count", "3", *output)
    assert simulate.wait(60) == 0
    model = tmp_path / "mine.safetensors"
    train = ("tcvae", "train", "--primitive", "dmp", "--json", "-o")
    process = start(*train, str(model), "--live")
    publisher = client.node.create_publisher(JointState, "/joint_states", 100)
    matched(publisher, process)
    # Twice as fast as it was.
    for folder in sorted((tmp_path / "sim").glob("[0-9]*")):
        publish(publisher, list(played(folder))[::2])
    time.sleep(0.5)
    process.signal(signal.SIGINT)
    found = answer(process, timeout=60)
    assert found["demonstrations"] >= 1, process.output
    kept = tmp_path / "mine.mcap"
    assert model.is_file() and kept.is_file()
    again = start(*train, str(tmp_path / "again.safetensors"), str(kept))
    assert answer(again, timeout=60)["model_id"] == found["model_id"]
    # What is for a recording only is refused without one.
    refused = start(*train, str(tmp_path / "other.safetensors"), str(kept), "--duration", "3")
    assert refused.wait(10) == 2 and "--live" in refused.output
    refused = start(*train, str(tmp_path / "other.safetensors"))
    assert refused.wait(10) == 2 and "RECORDINGS" in refused.output
