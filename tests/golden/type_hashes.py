"""The hashes (RIHS01) of the types that the node speaks, as rosidl's generators wrote them.

    .venv-kilted/bin/python tests/golden/type_hashes.py > tests/golden/type_hashes.json

src/ros/interfaces.rs is tested against the file. tcvae_msgs, tf2_msgs and control_msgs are built by
tests/interop/environment.py; the others come with the wheels.
"""

import json
import sys
from pathlib import Path

hashes = {}
packages = """
    action_msgs builtin_interfaces control_msgs diagnostic_msgs geometry_msgs lifecycle_msgs nav_msgs
    rcl_interfaces rosgraph_msgs sensor_msgs service_msgs std_msgs std_srvs tcvae_msgs tf2_msgs
    trajectory_msgs type_description_interfaces unique_identifier_msgs visualization_msgs
""".split()
for package in packages:
    for path in sorted((Path(sys.prefix) / "share" / package).glob("*/*.json")):
        for line in json.loads(path.read_text())["type_hashes"]:
            hashes[line["type_name"]] = line["hash_string"]
print(json.dumps(hashes, indent=0, sort_keys=True))
