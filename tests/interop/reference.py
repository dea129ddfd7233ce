"""Makes docs/interfaces.md from a running node and from msg/tcvae_msgs.

    ./x test ros -k reference        compares them
    TCVAE_WRITE_REFERENCE=1 ./x test ros -k reference        writes the file

What a name is for is said here, since the graph does not say it; a name that is not here, or not there, is an error.
"""

from pathlib import Path

from rcl_interfaces.srv import DescribeParameters, ListParameters
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / "docs" / "interfaces.md"
PACKAGE = ROOT / "msg" / "tcvae_msgs"

HEARD = {
    "~/goal_pose": "where to pour; publishing it asks for a trajectory. z and orientation are ignored after the frame "
                   "transform",
    "~/pour_location": "a location of the task; it asks for a trajectory only with `publish_on_task`",
    "~/source_cup": "likewise",
    "/joint_states": "where the arm is; joints in any order, also in parts",
    "/tf": "frames in which locations may be given",
    "/tf_static": "likewise",
}
TOLD = {
    "~/joint_trajectory": "the motion, ready for a `joint_trajectory_controller`: stamp 0, velocities and accelerations "
                          "filled, all joints of the arm",
    "~/end_effector_trajectory": "the same motion as timed poses of the tip",
    "~/end_effector_path": "the same as a path, for RViz",
    "~/markers": "path, uncertainty band, the task with its tolerance",
    "~/preview/joint_states": "a ghost that plays the motion at its speed",
    "~/robot_description": "URDF of the robot",
    "~/model_info": "JSON: what is served, with its measured scores",
    "~/transition_event": "each step of the lifecycle",
    "/diagnostics": "once a second: state, model, counts, latencies, last error",
    "/parameter_events": "every change of a parameter",
    "/rosout": "what the node says, with the reason of every refusal",
}
SERVICES = {
    "~/sample": "a motion for the latest task, published; needs no types of ours",
    "~/sample_trajectory": "one or several motions in the answer, with all that was measured of them",
    "~/set_manner": "turns manner parameters, all or none of them",
    "~/describe_primitive": "what the model can do, and how well that was measured",
    "~/load_model": "serves another model; one that does not fit is refused, and the old one stays",
    "~/change_state": "leads a managed node elsewhere",
    "~/get_state": "where it is",
    "~/get_available_states": "where it may be",
    "~/get_available_transitions": "what leads away from where it is",
    "~/get_transition_graph": "all that leads anywhere",
    "~/get_type_description": "what a type of the node's is made of, by its name and hash",
    "~/get_logger_levels": "which messages are logged",
    "~/set_logger_levels": "changes that",
    "~/describe_parameters": "parameters: descriptions, ranges, types",
    "~/get_parameter_types": "their types",
    "~/get_parameters": "their values",
    "~/list_parameters": "their names",
    "~/set_parameters": "sets each, or says why not",
    "~/set_parameters_atomically": "sets all, or none",
}
ACTIONS = {"~/execute": "samples, checks, approaches, and has the controller of `execute.controller` drive"}
TYPES = {1: "bool", 2: "integer", 3: "double", 4: "string", 8: "double[]"}


def private(name):
    return name.replace("/tcvae/", "~/")


def qos(info):
    profile = info.qos_profile
    words = ["reliable" if profile.reliability == ReliabilityPolicy.RELIABLE else "best effort"]
    if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        words.append("transient local")
    return ", ".join(words)


def table(header, rows):
    lines = [" | ".join(header), " | ".join("---" for _ in header), *(" | ".join(row) for row in rows)]
    return "\n".join(f"| {line} |" for line in lines) + "\n"


def topics(node, by_node, infos_of, texts):
    rows, found = [], {}
    for name, types in by_node:
        if "_action" in name or private(name) == "~/clock":
            continue
        (info,) = [i for i in infos_of(name) if i.node_name == "tcvae"]
        found[private(name)] = (types[0], qos(info))
    assert set(found) == set(texts), set(found) ^ set(texts)
    for name in texts:
        kind, profile = found[name]
        rows.append([f"`{name}`", f"`{kind}`", profile, texts[name]])
    return table(["topic", "type", "QoS", "what it is for"], rows)


def parameters(user):
    names = sorted(user.call(ListParameters, "list_parameters").result.names)
    rows = []
    for d in user.call(DescribeParameters, "describe_parameters", names=names).descriptors:
        ranges = [f"{r.from_value:g} to {r.to_value:g}" for r in [*d.floating_point_range, *d.integer_range]]
        rows.append([f"`{d.name}`", TYPES[d.type] + (", read-only" if d.read_only else ""),
                     "".join(ranges) or d.additional_constraints, d.description])
    return table(["parameter", "type", "range", "what it is"], rows)


def definition(kind, name):
    text = (PACKAGE / kind / f"{name}.{kind}").read_text().strip()
    return f"### `tcvae_msgs/{kind}/{name}`\n\n```\n{text}\n```\n"


def markdown(user):
    node = user.client.node
    heard = node.get_subscriber_names_and_types_by_node("tcvae", "/")
    told = node.get_publisher_names_and_types_by_node("tcvae", "/")
    services = {private(n): t[0] for n, t in node.get_service_names_and_types_by_node("tcvae", "/")}
    actions = {n.removesuffix("/_action/send_goal"): t.removesuffix("_SendGoal")
               for n, t in services.items() if n.endswith("/_action/send_goal")}
    services = {n: t for n, t in services.items() if "/_action/" not in n}
    assert set(services) == set(SERVICES), set(services) ^ set(SERVICES)
    assert set(actions) == set(ACTIONS), set(actions) ^ set(ACTIONS)
    definitions = [definition(kind, path.stem) for kind in ("msg", "srv", "action")
                   for path in sorted((PACKAGE / kind).glob(f"*.{kind}"))]
    parts = [
        "# Interface reference\n",
        "Made from a running node, with the built-in pouring model, and from `msg/tcvae_msgs`\n"
        "(`tests/interop/reference.py`). The node is called `tcvae`, so `~/x` is `/tcvae/x`. The locations of the task\n"
        "and the manner parameters are the model's. Units are ROS's: metres, radians, seconds.\n",
        "## Topics that it hears\n", topics(node, heard, node.get_subscriptions_info_by_topic, HEARD),
        "With `use_sim_time` it also hears `/clock`.\n",
        "## Topics that it tells\n", topics(node, told, node.get_publishers_info_by_topic, TOLD),
        "## Services\n",
        table(["service", "type", "what it does"], [[f"`{n}`", f"`{services[n]}`", SERVICES[n]] for n in SERVICES]),
        "## Actions\n",
        table(["action", "type", "what it does"], [[f"`{n}`", f"`{actions[n]}`", ACTIONS[n]] for n in ACTIONS]),
        "## Parameters\n", parameters(user),
        "## Definitions\n", *definitions,
    ]
    return "\n".join(parts)
