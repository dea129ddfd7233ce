"""Forward kinematics and Jacobians by Pinocchio, for tests/kinematics.rs.

    pip install pin==4.1.0 && python tests/golden/forward.py

reads config/baxter.urdf and tests/fixtures/odd_arm.urdf and writes tests/golden/forward.json:
random configurations inside the limits, the tip's pose (position; quaternion x y z w) and the
Jacobian at the tip in the base's axes (row by row, linear velocity first).
"""

import json
from pathlib import Path

import numpy as np
import pinocchio as pin

ROOT = Path(__file__).resolve().parents[2]
ARM = ["s0", "s1", "e0", "e1", "w0", "w1", "w2"]
CASES = [
    ("config/baxter.urdf", "base", "left_gripper", [f"left_{j}" for j in ARM], 60),
    ("config/baxter.urdf", "base", "right_gripper", [f"right_{j}" for j in ARM], 60),
    ("tests/fixtures/odd_arm.urdf", "world", "tool", ["turn", "lift", "bend", "nod"], 60),
    # From a frame in the middle of the arm.
    ("tests/fixtures/odd_arm.urdf", "carriage", "flange", ["bend", "nod"], 20),
]


def main():
    rng = np.random.default_rng(7)
    chains = []
    for path, base, tip, joints, count in CASES:
        model = pin.buildModelFromUrdf(str(ROOT / path))
        data = model.createData()
        base_id, tip_id = model.getFrameId(base), model.getFrameId(tip)
        velocity_index = [model.joints[model.getJointId(j)].idx_v for j in joints]
        cases = []
        for _ in range(count):
            tangent = np.zeros(model.nv)
            values = []
            for joint in joints:
                joint = model.joints[model.getJointId(joint)]
                if joint.nq == 2:  # continuous: cosine and sine
                    value = rng.uniform(-4, 4)
                else:
                    low, high = model.lowerPositionLimit, model.upperPositionLimit
                    value = rng.uniform(low[joint.idx_q], high[joint.idx_q])
                tangent[joint.idx_v] = value
                values.append(value)
            q = pin.integrate(model, pin.neutral(model), tangent)
            pin.computeJointJacobians(model, data, q)
            pin.updateFramePlacements(model, data)
            world_from_base = data.oMf[base_id]
            base_from_tip = world_from_base.actInv(data.oMf[tip_id])
            jacobian = pin.getFrameJacobian(model, data, tip_id, pin.LOCAL_WORLD_ALIGNED)
            turn = world_from_base.rotation.T
            jacobian = np.vstack([turn @ jacobian[:3], turn @ jacobian[3:]])[:, velocity_index]
            cases.append(
                {
                    "q": values,
                    "position": base_from_tip.translation.tolist(),
                    "quaternion_xyzw": pin.Quaternion(base_from_tip.rotation).coeffs().tolist(),
                    "jacobian": jacobian.flatten().tolist(),
                }
            )
        chains.append({"urdf": path, "base": base, "tip": tip, "joints": joints, "cases": cases})
    out = Path(__file__).with_suffix(".json")
    made_by = f"pinocchio {pin.__version__}"
    lines = ",\n".join(
        json.dumps({k: v for k, v in chain.items() if k != "cases"})[:-1]
        + ', "cases": [\n'
        + ",\n".join(json.dumps(case) for case in chain["cases"])
        + "\n]}"
        for chain in chains
    )
    out.write_text(f'{{"made_by": "{made_by}", "chains": [\n{lines}\n]}}\n')


if __name__ == "__main__":
    main()
