"""Writes tests/golden/approach.json: how long Ruckig takes along straight ways through joint space, from rest to
rest, with and without limits of the jerk. A straight way has one degree of freedom, its share, whose limits are
the tightest of the joints'.

    pip install ruckig==0.19.4 && python tests/golden/approach.py
"""

import json
import math
import random
from pathlib import Path

from ruckig import InputParameter, Result, Ruckig, Trajectory

random.seed(1)


def log_uniform(low, high):
    return round(math.exp(random.uniform(math.log(low), math.log(high))), 3)


def duration(velocity, acceleration, jerk):
    otg, wish, trajectory = Ruckig(1), InputParameter(1), Trajectory(1)
    wish.current_position, wish.target_position = [0.0], [1.0]
    wish.max_velocity, wish.max_acceleration, wish.max_jerk = [velocity], [acceleration], [jerk]
    assert otg.calculate(wish, trajectory) in (Result.Working, Result.Finished)
    return trajectory.duration


cases = []
for i in range(200):
    from_, to = ([round(random.uniform(-3, 3), 3) for _ in range(2)] for _ in range(2))
    if i % 5 == 0:
        to[0] = round(from_[0] + log_uniform(0.001, 0.1), 3)
        to[1] = from_[1]
    case = {
        "from": from_,
        "to": to,
        "velocity": [log_uniform(0.3, 3) for _ in range(2)],
        "acceleration": [log_uniform(0.3, 10) for _ in range(2)],
        "jerk": [log_uniform(1, 200) for _ in range(2)] if i % 2 else None,
    }
    ways = [abs(b - a) for a, b in zip(from_, to)]
    limits = [
        min((limit / way for limit, way in zip(limits, ways) if way > 0), default=math.inf) if limits else math.inf
        for limits in (case["velocity"], case["acceleration"], case["jerk"])
    ]
    cases.append(case | {"duration_secs": duration(*limits)})
path = Path(__file__).parent / "approach.json"
path.write_text("[\n" + ",\n".join(json.dumps(case) for case in cases) + "\n]\n")
print(f"{len(cases)} cases in {path.name}")
