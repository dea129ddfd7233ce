//! The files of a demonstration, as MIME has them: noise, the other arm, stray lines, damage.

use rand::RngExt;
use rand::rngs::ChaCha8Rng;

use super::plan::Plan;
use super::{Assignment, MIME_JOINTS, RATE_HZ, RawDemonstration, normal};
use crate::demonstrations::mirroring::mirrored_joints;
use crate::demonstrations::recording::{Reason, RobotConfig};

impl Plan {
    /// The files of this demonstration, with what goes wrong in them.
    pub(super) fn raw(
        &self,
        assignment: &Assignment,
        robot: &RobotConfig,
        mut joints: Vec<Vec<f64>>,
        rng: &mut ChaCha8Rng,
    ) -> RawDemonstration {
        let dof = robot.arm.joints.len();
        let trap = assignment.trap;
        let accident = ((self.accident_secs * RATE_HZ) as usize).min(joints.len() - 2);
        let mut keep = joints.len();
        match trap {
            Some(Reason::Jump) => {
                let joint = rng.random_range(0..dof);
                let by = rng.random_range(1.2..2.2) * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
                let lasts =
                    if rng.random_bool(0.5) { joints.len() } else { rng.random_range(1..40) };
                for q in joints.iter_mut().skip(accident).take(lasts) {
                    q[joint] += by;
                }
            }
            Some(Reason::TooShort) => keep = accident,
            // Either the cup was dropped, or the recording ends here.
            Some(Reason::Incomplete) if self.gripper_changes.len() != 2 => keep = accident,
            Some(Reason::Incomplete) if self.gripper_changes[1] != self.accident_secs => {
                keep = accident;
            }
            _ => {}
        }
        if trap != Some(Reason::Jump) && rng.random_bool(0.1) {
            // A single encoder step of 2 to 4 rad/s, which is no reason to reject a recording.
            let frame = rng.random_range(0..joints.len());
            let joint = rng.random_range(0..dof);
            joints[frame][joint] += rng.random_range(0.02..0.04);
        }
        joints.truncate(keep);
        let frames = joints.len();
        let mut other = robot.mirrored_arm.as_ref().map(|_| other_arm(dof, frames, rng));
        for arm in std::iter::once(&mut joints).chain(&mut other) {
            add_noise(arm, rng);
        }
        let head = [rng.random_range(-0.3..0.3), 0.0, 0.0];
        // The served arm makes the motion, or the mirrored one its mirror image.
        let mirror = |arm: Vec<Vec<f64>>, signs: &[f64]| -> Vec<Vec<f64>> {
            arm.iter().map(|q| mirrored_joints(q, signs)).collect()
        };
        let signs = robot.mirrored_arm.as_ref().and_then(|arm| arm.mirror_signs.as_deref());
        let arms = match (other, signs) {
            (Some(other), Some(signs)) if assignment.right => vec![other, mirror(joints, signs)],
            (Some(other), Some(signs)) => vec![joints, mirror(other, signs)],
            _ => vec![joints],
        };
        let joint_names = columns(robot);
        let value = |name: &String, frame: usize| {
            let of_arm = robot.arms().zip(&arms).find_map(|(arm, values)| {
                let joint = arm.joints.iter().position(|joint| joint == name)?;
                Some(values[frame][joint])
            });
            of_arm.unwrap_or(head[usize::from(name != "head_pan")])
        };
        let frames_out = (0..frames)
            .map(|frame| joint_names.iter().map(|n| value(n, frame)).collect())
            .collect();

        let acting = usize::from(assignment.right);
        let acting_gripper = self.gripper(trap, frames, rng);
        let mut grippers: Vec<(String, Vec<f64>)> = Vec::new();
        let idle = robot.mirrored_arm.as_ref().map(|_| idle_gripper(frames, rng));
        let mut of_arms = vec![Some(acting_gripper), idle];
        if acting == 1 {
            of_arms.swap(0, 1);
        }
        for (arm, values) in robot.arms().zip(of_arms) {
            grippers.extend(arm.gripper.clone().zip(values));
        }
        let stray_lines = (0..rng.random_range(0..=4))
            .map(|_| {
                let width = rng.random_range(0.0..0.0208);
                let line = if rng.random_bool(0.7) {
                    format!("{{\"l_gripper_l_finger_joint\": {width:.17}}}")
                } else {
                    format!("{width:.17}")
                };
                (rng.random_range(0..=frames), line)
            })
            .collect();
        let mut raw = RawDemonstration {
            id: assignment.id.clone(),
            joint_names,
            frames: frames_out,
            grippers,
            stray_lines,
            cut_lines: Vec::new(),
            python_syntax: rng.random_bool(0.15),
        };
        raw.stray_lines.sort_by_key(|(frame, _)| *frame);
        if trap == Some(Reason::Unreadable) {
            match rng.random_range(0..2) {
                0 => raw.cut_lines = (0..frames).filter(|_| rng.random_bool(0.1)).collect(),
                _ => {
                    if let Some((_, values)) = raw.grippers.get_mut(acting) {
                        values.clear();
                    }
                }
            }
        }
        raw
    }

    /// Per cent open of the gripper that grasps, in a number of lines that is not that of frames.
    fn gripper(&self, trap: Option<Reason>, frames: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
        let open = rng.random_range(92.0..100.0_f64);
        let closed = if trap == Some(Reason::NoGrasp) {
            // It never closes on anything.
            rng.random_range(75.0..open)
        } else {
            rng.random_range(1.0..14.0)
        };
        let at = |t: f64| {
            let changes = self.gripper_changes.iter().filter(|&&change| change <= t).count();
            if changes % 2 == 1 { closed } else { open }
        };
        other_length(frames, rng).map(|frame| at(frame / RATE_HZ)).collect()
    }
}

/// The joints of a frame: those of MIME where these are the robot's, else those of its arms.
fn columns(robot: &RobotConfig) -> Vec<String> {
    let own: Vec<String> = robot.arms().flat_map(|arm| arm.joints.clone()).collect();
    if own.iter().all(|joint| MIME_JOINTS.contains(&joint.as_str())) {
        MIME_JOINTS.map(String::from).to_vec()
    } else {
        own
    }
}

/// The arm that doesn't act: it hangs where it was left, and drifts.
fn other_arm(dof: usize, frames: usize, rng: &mut ChaCha8Rng) -> Vec<Vec<f64>> {
    // Baxter's, the joints of other arms hang at 0 beyond as many.
    const REST: [f64; 7] = [0.1, -0.55, 0.0, 0.75, 0.0, 1.26, 0.0];
    // The limits of Baxter's joints nearest to where some of MIME's angles lie beyond them.
    const LIMITS: [(usize, f64, f64); 5] =
        [(0, -1.7017, -1.0), (1, 1.047, 1.0), (3, -0.05, -1.0), (5, 2.094, 1.0), (6, -3.059, -1.0)];
    let mut rest: Vec<f64> = (0..dof)
        .map(|joint| REST.get(joint).copied().unwrap_or(0.0) + 0.25 * normal(rng))
        .collect();
    if rng.random_bool(0.25) {
        let (joint, limit, side) = LIMITS[rng.random_range(0..LIMITS.len())];
        let beyond = rng.random_range(0.02..0.17);
        if let Some(rest) = rest.get_mut(joint) {
            *rest = limit + side * beyond;
        }
    }
    let mut drift = || {
        let rate = rng.random_range(0.1..0.5);
        let phase = rng.random_range(0.0..std::f64::consts::TAU);
        (0.02 * normal(rng), rate, phase, 0.002 * normal(rng))
    };
    let drift: Vec<_> = rest.iter().map(|_| drift()).collect();
    let frame = |i: usize| {
        let t = i as f64 / RATE_HZ;
        let drifted = |(q, (size, rate, phase, slope)): (&f64, &(f64, f64, f64, f64))| {
            q + size * (rate * t + phase).sin() + slope * t
        };
        rest.iter().zip(&drift).map(drifted).collect()
    };
    (0..frames).map(frame).collect()
}

/// The gripper of the arm that doesn't act: open, closed all the time, or holding the bowl.
fn idle_gripper(frames: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let (open, closed) = (rng.random_range(92.0..100.0), rng.random_range(0.0..10.0));
    let closes_at = match rng.random_range(0..4) {
        0 => 0.0,
        1 => rng.random_range(0.1..0.5) * frames as f64,
        _ => f64::INFINITY,
    };
    other_length(frames, rng).map(|frame| if frame >= closes_at { closed } else { open }).collect()
}

/// The frames (with fractions) at which a gripper's file has its lines: as many as frames, and up
/// to 3 % more or fewer.
fn other_length(frames: usize, rng: &mut ChaCha8Rng) -> impl Iterator<Item = f64> + use<> {
    let sign = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let lines = (frames as f64 * (1.0 + sign * rng.random_range(0.01..0.03))).round() as usize;
    let lines = lines.max(2);
    let scale = (frames.max(2) - 1) as f64 / (lines - 1) as f64;
    (0..lines).map(move |i| i as f64 * scale)
}

/// Adds the noise of encoders and of a guiding hand: 0.3 mrad, mostly below 6 Hz.
fn add_noise(joints: &mut [Vec<f64>], rng: &mut ChaCha8Rng) {
    const STDDEV_RAD: f64 = 3e-4;
    const CORNER_HZ: f64 = 6.0;
    let keep = (-std::f64::consts::TAU * CORNER_HZ / RATE_HZ).exp();
    let add = STDDEV_RAD * (1.0 - keep * keep).sqrt();
    let dof = joints.first().map_or(0, Vec::len);
    let mut noise: Vec<f64> = (0..dof).map(|_| STDDEV_RAD * normal(rng)).collect();
    for q in joints {
        for (q, noise) in q.iter_mut().zip(&mut noise) {
            *noise = keep * *noise + add * normal(rng);
            *q += *noise;
        }
    }
}
