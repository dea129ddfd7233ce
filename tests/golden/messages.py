"""Random messages of every type on the node's wire, with rclpy's serialisation of each.

    .venv-kilted/bin/python tests/golden/messages.py > tests/golden/messages.json

src/ros/messages/ is tested against the file; tests/interop checks that each distro still writes
the same. One line per message: {"type", "fields": [[name, type], ...], "value", "cdr": hex}, with
zeros in the padding, which rclpy leaves uninitialised.
"""

import importlib
import json
import random
import re
import struct
import sys

from rclpy.serialization import deserialize_message, serialize_message

TYPES = """
builtin_interfaces/msg/Time builtin_interfaces/msg/Duration
std_msgs/msg/Header std_msgs/msg/String
geometry_msgs/msg/Point geometry_msgs/msg/Vector3 geometry_msgs/msg/Quaternion geometry_msgs/msg/Pose
geometry_msgs/msg/Transform geometry_msgs/msg/Twist geometry_msgs/msg/PointStamped
geometry_msgs/msg/PoseStamped geometry_msgs/msg/TransformStamped
tf2_msgs/msg/TFMessage sensor_msgs/msg/JointState
trajectory_msgs/msg/JointTrajectoryPoint trajectory_msgs/msg/JointTrajectory
trajectory_msgs/msg/MultiDOFJointTrajectoryPoint trajectory_msgs/msg/MultiDOFJointTrajectory
std_msgs/msg/ColorRGBA sensor_msgs/msg/CompressedImage
visualization_msgs/msg/UVCoordinate visualization_msgs/msg/MeshFile
diagnostic_msgs/msg/KeyValue diagnostic_msgs/msg/DiagnosticStatus diagnostic_msgs/msg/DiagnosticArray
lifecycle_msgs/msg/TransitionEvent lifecycle_msgs/srv/GetState_Request lifecycle_msgs/srv/GetState_Response
lifecycle_msgs/srv/ChangeState_Request lifecycle_msgs/srv/ChangeState_Response
lifecycle_msgs/srv/GetAvailableStates_Response lifecycle_msgs/srv/GetAvailableTransitions_Response
visualization_msgs/msg/Marker visualization_msgs/msg/MarkerArray
nav_msgs/msg/Path std_srvs/srv/Trigger_Request std_srvs/srv/Trigger_Response
tcvae_msgs/msg/TaskLocation tcvae_msgs/msg/MannerParameter tcvae_msgs/msg/Sample
tcvae_msgs/srv/SampleTrajectory_Request tcvae_msgs/srv/SampleTrajectory_Response
tcvae_msgs/srv/SetManner_Request tcvae_msgs/srv/SetManner_Response
tcvae_msgs/srv/DescribePrimitive_Request tcvae_msgs/srv/DescribePrimitive_Response
tcvae_msgs/srv/LoadModel_Request tcvae_msgs/srv/LoadModel_Response
tcvae_msgs/action/Execute_Goal tcvae_msgs/action/Execute_Result tcvae_msgs/action/Execute_Feedback
rcl_interfaces/msg/Log rcl_interfaces/msg/ParameterEvent
rcl_interfaces/srv/ListParameters_Request rcl_interfaces/srv/ListParameters_Response
rcl_interfaces/srv/GetParameters_Request rcl_interfaces/srv/GetParameters_Response
rcl_interfaces/srv/GetParameterTypes_Request rcl_interfaces/srv/GetParameterTypes_Response
rcl_interfaces/srv/SetParameters_Request rcl_interfaces/srv/SetParameters_Response
rcl_interfaces/srv/SetParametersAtomically_Request rcl_interfaces/srv/SetParametersAtomically_Response
rcl_interfaces/srv/DescribeParameters_Request rcl_interfaces/srv/DescribeParameters_Response
""".split()

CASES = 3  # messages per type: one without list elements, two random ones
INTEGER = {"int8": 7, "int16": 15, "int32": 31, "int64": 63}
INTEGER |= {"uint8": 8, "octet": 8, "uint16": 16, "uint32": 32, "uint64": 64}
# An empty request has no field; ROS serialises one byte of zero in their place.
EMPTY = [["structure_needs_at_least_one_member", "uint8"]]


def message_class(name):
    """The Python class of package/kind/Type, or of package/Type for a message in a field."""
    package, *kind, last = name.split("/")
    module = importlib.import_module(f"{package}.{kind[0] if kind else 'msg'}")
    outer, _, part = last.partition("_")
    return getattr(getattr(module, outer), part) if part else getattr(module, last)


def fields(cls):
    return [[name, kind] for name, kind in cls.get_fields_and_field_types().items()]


def fill(kind, rng, depth, empty):
    """A random value of a field type: (what JSON holds, what rclpy takes)."""
    sequence = re.fullmatch(r"sequence<(.+?)(?:, (\d+))?>", kind)
    if sequence:
        limit = min(int(sequence[2] or 9), 3 if depth == 0 else 2)
        length = 0 if empty else rng.randint(min(depth == 0, limit), limit)
        items = [fill(sequence[1], rng, depth + 1, empty) for _ in range(length)]
        plain, taken = [plain for plain, _ in items], [value for _, value in items]
        return plain, taken
    if kind == "boolean":
        value = rng.random() < 0.5
    elif kind == "float":
        value = struct.unpack("<f", struct.pack("<f", rng.gauss(0, 1)))[0]
    elif kind == "double":
        value = rng.choice([rng.gauss(0, 1), rng.uniform(-1e6, 1e6), 0.0, -0.0, 5e-324, 1e300])
    elif kind == "string":
        value = "".join(rng.choice("abcz_/ é√") for _ in range(rng.randint(0, 9)))
    elif kind in INTEGER:
        value = rng.getrandbits(INTEGER[kind])
        if kind.startswith("int") and rng.random() < 0.5:
            value = -value - 1
    else:
        return make(message_class(kind), rng, depth + 1, empty)
    return value, bytes([value]) if kind == "octet" else value


def make(cls, rng, depth=0, empty=False):
    """A random message of a class: (what JSON holds, the message)."""
    message, plain = cls(), {}
    for name, kind in fields(cls):
        plain[name], value = fill(kind, rng, depth, empty)
        if name == "nanosec":  # only below a second is a time well formed
            plain[name] = value = value % 1_000_000_000
        setattr(message, name, value)
    return plain, message


def data_ranges(kind, plain, at):
    """Where a value's bytes are in CDR, from offset `at` on: (ranges of them, next offset)."""
    sequence = re.fullmatch(r"sequence<(.+?)(?:, (\d+))?>", kind)
    if sequence or kind == "string":
        at += -at % 4
        ranges, next_at = [(at, at + 4)], at + 4  # the length
        if kind == "string":
            size = len(plain.encode()) + 1
            return [*ranges, (next_at, next_at + size)], next_at + size
        items = [(sequence[1], item) for item in plain]
    elif "/" in kind:
        items = [(kind, plain[name]) for name, kind in fields(message_class(kind)) or EMPTY]
        ranges, next_at = [], at
    else:
        size = {"boolean": 1, "double": 8, "float": 4}.get(kind) or (INTEGER[kind] + 7) // 8
        at += -at % size
        return [(at, at + size)], at + size
    for item_kind, item in items:
        more, next_at = data_ranges(item_kind, item, next_at)
        ranges += more
    return ranges, next_at


def serialize(name, plain, message):
    """rclpy's bytes: a header of four, then the data.

    The padding, which Fast CDR leaves as it found the memory, is set to zero. The end is cut to
    the data: rclpy returns as many bytes as it had estimated, which for empty lists of doubles
    are up to 7 too many. rclpy must read the same message back from what remains.
    """
    raw = serialize_message(message)
    ranges, end = data_ranges(name, plain, 0)
    assert len(raw) >= 4 + end, f"{name}: {len(raw)} bytes, expected {4 + end}"
    out = bytearray(4 + end)
    for start, stop in [(-4, 0), *ranges]:
        out[4 + start : 4 + stop] = raw[4 + start : 4 + stop]
    assert deserialize_message(bytes(out), type(message)) == message, name
    return bytes(out)


def lines():
    for name in TYPES:
        cls = message_class(name)
        for case in range(CASES):
            plain, message = make(cls, random.Random(f"{name} {case}"), empty=case == 0)
            plain = plain or {EMPTY[0][0]: 0}
            cdr = serialize(name, plain, message).hex()
            line = {"type": name, "fields": fields(cls) or EMPTY, "value": plain, "cdr": cdr}
            yield json.dumps(line, ensure_ascii=False)


def golden():
    """The whole file."""
    return "[\n" + ",\n".join(lines()) + "\n]\n"


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")
    sys.stdout.write(golden())
