"""The files for RViz and Foxglove in config/: what they name exists on the running node, with the type and the QoS
that they need. Neither program runs here; that their panels exist is not tested."""

import json
import re
from pathlib import Path

import pytest
import yaml
from conftest import ROOT
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.qos import DurabilityPolicy
from std_srvs.srv import Trigger
from tcvae_msgs.srv import DescribePrimitive
from trajectory_msgs.msg import JointTrajectoryPoint
from user import User

RVIZ = ROOT / "config" / "tcvae.rviz"
FOXGLOVE = ROOT / "config" / "foxglove-layout.json"
LATCHED = DurabilityPolicy.TRANSIENT_LOCAL

POSE, POINT = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PointStamped"
URDF, PATH = "std_msgs/msg/String", "nav_msgs/msg/Path"
MARKERS, TRAJECTORY = "visualization_msgs/msg/MarkerArray", "trajectory_msgs/msg/JointTrajectory"

# What RViz's displays and tools take and give.
RVIZ_SHOWS = {"RobotModel": URDF, "Path": PATH, "MarkerArray": MARKERS}
RVIZ_GIVES = {"SetGoal": POSE, "PublishPoint": POINT}


def rviz_parts():
    """(class, settings of the topic) of the displays and the tools that have a topic."""
    manager = yaml.safe_load(RVIZ.read_text())["Visualization Manager"]
    for part in [*manager["Displays"], *manager["Tools"]]:
        topic = part.get("Description Topic") or part.get("Topic")
        if topic:
            yield part["Class"].rpartition("/")[2], topic


def panels():
    """(kind, settings) of the panels of Foxglove's layout."""
    for name, settings in json.loads(FOXGLOVE.read_text())["configById"].items():
        yield name.partition("!")[0], settings


def of_kind(kind):
    return [settings for name, settings in panels() if name == kind]


def shown():
    """(file, topic, type) of each topic that is shown."""
    for kind, topic in rviz_parts():
        if kind in RVIZ_SHOWS:
            yield "rviz", topic["Value"], RVIZ_SHOWS[kind]
    for scene in of_kind("3D"):
        for topic, settings in scene["topics"].items():
            yield "foxglove", topic, MARKERS if "namespaces" in settings else PATH
        for layer in scene["layers"].values():
            if layer["layerId"] == "foxglove.Urdf":
                yield "foxglove", layer["topic"], URDF
    for plot in of_kind("Plot"):
        for path in plot["paths"]:
            yield "foxglove", path["value"].partition(".")[0], TRAJECTORY
    for log in of_kind("RosOut"):
        yield "foxglove", log["topicToRender"], "rcl_interfaces/msg/Log"
    for summary in of_kind("DiagnosticSummary"):
        yield "foxglove", summary["topicToRender"], "diagnostic_msgs/msg/DiagnosticArray"


def given():
    """(file, topic, type) of each topic that is published to."""
    for kind, topic in rviz_parts():
        if kind in RVIZ_GIVES:
            yield "rviz", topic["Value"], RVIZ_GIVES[kind]
    for scene in of_kind("3D"):
        yield "foxglove", scene["publish"]["poseTopic"], POSE
        yield "foxglove", scene["publish"]["pointTopic"], POINT
    for panel in of_kind("Publish"):
        yield "foxglove", panel["topicName"], panel["datatype"]


def called():
    return [panel["serviceName"] for panel in of_kind("CallService")]


def filled(message, fields):
    """A message with the fields of a JSON text; one that it does not have fails."""
    for name, content in fields.items():
        if isinstance(content, dict):
            filled(getattr(message, name), content)
        else:
            setattr(message, name, type(getattr(message, name))(content))
    return message


@pytest.mark.parametrize("file", [RVIZ, FOXGLOVE], ids=["rviz", "foxglove"])
def test_every_name_in_the_file_is_one_that_is_looked_up_here(file):
    names = set(re.findall(r'["\s](/[a-z_]+(?:/[a-z_]+)*)', "\n".join(
        line for line in file.read_text().splitlines() if not line.startswith("#"))))
    ours = {topic for _, topic, _ in [*shown(), *given()]} | set(called())
    assert names and names <= ours, sorted(names - ours)
    assert len([topic for f, topic, _ in shown() if f == file_kind(file)]) >= 3
    assert len([topic for f, topic, _ in given() if f == file_kind(file)]) >= 2


def file_kind(file: Path):
    return "rviz" if file == RVIZ else "foxglove"


def test_what_is_shown_is_published_with_that_type(node, client):
    topics = lambda: dict(client.node.get_topic_names_and_types())
    for file, topic, kind in shown():
        found = client.spin_until(lambda: client.node.count_publishers(topic) > 0, 10.0)
        assert found is not None, f"{file}: nobody publishes {topic}"
        assert topics()[topic] == [kind], f"{file}: {topic} is {topics()[topic]}"


def test_what_is_given_is_heard_with_that_type(node, client):
    topics = lambda: dict(client.node.get_topic_names_and_types())
    for file, topic, kind in given():
        found = client.spin_until(lambda: client.node.count_subscribers(topic) > 0, 10.0)
        assert found is not None, f"{file}: nobody listens on {topic}"
        assert topics()[topic] == [kind], f"{file}: {topic} is {topics()[topic]}"


def test_the_services_exist(node, client):
    assert called()
    services = lambda: dict(client.node.get_service_names_and_types())
    for service in called():
        assert client.spin_until(lambda: service in services(), 10.0) is not None, service
        assert services()[service] == ["std_srvs/srv/Trigger"]


def test_rviz_asks_for_what_was_published_before_it_came_where_the_node_keeps_it(node, client):
    for kind, topic in rviz_parts():
        if kind not in RVIZ_SHOWS:
            continue
        found = lambda: client.node.get_publishers_info_by_topic(topic["Value"])
        assert client.spin_until(found, 10.0) is not None, topic
        assert found()[0].qos_profile.durability == LATCHED
        assert topic["Durability Policy"] == "Transient Local"


def test_plots_name_the_fields_and_the_joints_of_the_trajectory(node, user):
    joints = user.call(DescribePrimitive, "describe_primitive").joint_names
    fields = JointTrajectoryPoint.get_fields_and_field_types()
    for plot in of_kind("Plot"):
        assert plot["xAxisVal"] == "index"
        assert [path["label"] for path in plot["paths"]] == list(joints)
        for index, path in enumerate(plot["paths"]):
            field, at = re.fullmatch(r"/tcvae/joint_trajectory\.points\[:\]\.(\w+)\[(\d)\]", path["value"]).groups()
            assert fields[field] == "sequence<double>" and int(at) == index


def test_the_panels_of_the_layout_pour(node, make_client):
    user = User(make_client("foxglove"))
    kinds = {POINT: PointStamped, POSE: PoseStamped}
    buttons = [(panel["topicName"], filled(kinds[panel["datatype"]](), json.loads(panel["value"])))
               for panel in of_kind("Publish")]
    assert [topic for topic, _ in buttons] == ["/tcvae/source_cup", "/tcvae/goal_pose"]
    for topic, message in buttons:
        publisher = user.matched(user.client.node.create_publisher(type(message), topic, 10))
        assert user.trajectory(0.2) is None
        publisher.publish(message)
        user.wait(0.2)
    assert user.trajectory() is not None, [m.msg for m in user.log]
    (service,) = called()
    (panel,) = of_kind("CallService")
    request = filled(Trigger.Request(), json.loads(panel["requestPayload"]))
    answer, _ = user.client.call(user.client.service(Trigger, service), request)
    assert answer.success, answer.message
    assert user.trajectory() is not None


def test_the_layout_places_every_panel_once():
    document = json.loads(FOXGLOVE.read_text())

    def placed(part):
        return [part] if isinstance(part, str) else [*placed(part["first"]), *placed(part["second"])]

    assert sorted(placed(document["layout"])) == sorted(document["configById"])
