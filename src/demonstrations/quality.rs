//! What is notable about a recording, whether or not it shows a demonstration: what a person looks at
//! who wonders why it was left out, or whether to leave it out.

use nalgebra::Isometry3;

use super::Demonstration;
use super::manipulation::ManipulationTask;
use super::recording::{ArmRecording, JointRecording, Jump, RobotConfig};
use crate::kinematics::Chain;
use crate::pose::{StateFrame, tilt, up_in_tip};
use crate::trajectory::Motion;

/// Frames further apart than this many times the usual are a gap.
const GAP: f64 = 3.0;

/// Points of a [`Timeline`], at most.
const TIMELINE_POINTS: usize = 200;

/// What is notable about a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Quality {
    /// Number of frames.
    pub frames: usize,
    /// Pairs of frames that are three times as far apart as the median pair.
    pub gaps: usize,
    /// Time between the two frames that are furthest apart.
    pub longest_gap_secs: f64,
    /// The largest change of a joint within the window of the task's rules.
    pub largest_jump: Option<Jump>,
    /// Time before any arm moves.
    pub idle_start_secs: f64,
    /// Time after every arm has moved last.
    pub idle_end_secs: f64,
    /// The arms that may demonstrate the task, as far as they are in the recording.
    pub arms: Vec<ArmQuality>,
}

/// What is notable about an arm in a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct ArmQuality {
    /// Name of the arm.
    pub arm: String,
    /// How far the tip came about: the diagonal of the box around its positions, m.
    pub extent_m: f64,
    /// Times that the gripper closes and holds something; absent without a gripper.
    pub grasps: Option<usize>,
    /// Times that the task's action happens.
    pub actions: usize,
    /// Frames with a joint outside its limits.
    pub frames_outside: usize,
    /// The joint that is furthest outside, and by how much (rad, or m).
    pub furthest_outside: Option<(String, f64)>,
    /// The arm over time.
    pub timeline: Timeline,
}

/// An arm over time, at most 200 points of it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Timeline {
    /// Times of the points.
    pub times_secs: Vec<f64>,
    /// Tilt of the axis that points up when the gripper first closes, or in the first frame.
    pub tilt_deg: Vec<f64>,
    /// Height of the tip in the base frame.
    pub height_m: Vec<f64>,
    /// Per cent that the gripper is open; empty without a gripper.
    pub percent_open: Vec<f64>,
}

impl ManipulationTask {
    /// What is notable about a recording.
    ///
    /// # Panics
    /// When an arm of the robot has not as many joints as the chain.
    pub fn quality(
        &self,
        recording: &JointRecording,
        robot: &RobotConfig,
        chain: &Chain,
    ) -> Quality {
        let times = &recording.times_secs;
        let mut steps: Vec<f64> = times.windows(2).map(|t| t[1] - t[0]).collect();
        let longest_gap_secs = steps.iter().copied().fold(0.0, f64::max);
        steps.sort_by(f64::total_cmp);
        let usual = steps.get(steps.len() / 2).copied().unwrap_or(0.0);
        let motions: Vec<ArmRecording> =
            self.arms(robot).filter_map(|arm| arm.motion(recording, chain).ok()).collect();
        let duration = recording.duration_secs();
        let (mut idle_start_secs, mut idle_end_secs) = (duration, duration);
        for motion in &motions {
            let moves = self.recording.moves(times, &motion.positions);
            if let (Some([first, _]), Some([_, end])) = (moves.first(), moves.last()) {
                idle_start_secs = idle_start_secs.min(times[*first] - times[0]);
                idle_end_secs = idle_end_secs.min(times[times.len() - 1] - times[end - 1]);
            }
        }
        Quality {
            frames: times.len(),
            gaps: steps.iter().filter(|&&step| step > GAP * usual).count(),
            longest_gap_secs,
            largest_jump: recording.largest_jump(self.recording.jump_window_secs),
            idle_start_secs,
            idle_end_secs,
            arms: motions.iter().map(|motion| self.arm_quality(motion, chain)).collect(),
        }
    }

    fn arm_quality(&self, motion: &ArmRecording, chain: &Chain) -> ArmQuality {
        let mut frames_outside = 0;
        let mut furthest: Option<(&str, f64)> = None;
        for q in &motion.positions {
            let beyond =
                chain.joints().iter().zip(q).map(|(joint, q)| {
                    (joint.name.as_str(), (joint.lower - q).max(q - joint.upper))
                });
            let worst = beyond.max_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, by)| *by > 0.0);
            frames_outside += usize::from(worst.is_some());
            if let Some(worst) = worst
                && furthest.is_none_or(|(_, by)| worst.1 > by)
            {
                furthest = Some(worst);
            }
        }
        let holds =
            motion.percent_open.as_ref().map(|open| self.recording.holds(&motion.times_secs, open));
        let upright = holds.iter().flatten().map(|[first, _]| *first).find(|first| *first > 0);
        ArmQuality {
            arm: motion.arm.clone(),
            extent_m: motion.extent_m(),
            grasps: holds.map(|holds| holds.iter().filter(|[first, _]| *first > 0).count()),
            actions: self.count_actions(motion),
            frames_outside,
            furthest_outside: furthest.map(|(name, by)| (name.to_owned(), by)),
            timeline: timeline(motion, upright.unwrap_or(0)),
        }
    }
}

/// An arm over time, against its orientation in frame `upright`.
fn timeline(motion: &ArmRecording, upright: usize) -> Timeline {
    let frames = motion.times_secs.len();
    if frames == 0 {
        return Timeline::default();
    }
    let axis = up_in_tip(&motion.base_from_tip[upright]);
    let stride = frames.div_ceil(TIMELINE_POINTS);
    let points = || (0..frames).step_by(stride);
    let open = |i: usize| motion.percent_open.as_ref().map(|open| open[i]);
    Timeline {
        times_secs: points().map(|i| motion.times_secs[i]).collect(),
        tilt_deg: points().map(|i| tilt(&motion.base_from_tip[i], &axis).to_degrees()).collect(),
        height_m: points().map(|i| motion.base_from_tip[i].translation.z).collect(),
        percent_open: points().filter_map(open).collect(),
    }
}

/// The demonstration that is most like another one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Neighbour {
    /// Its place among the demonstrations.
    pub index: usize,
    /// Root mean square distance of the tip over the phase, m.
    pub motion_m: f64,
    /// Largest distance between their locations, m.
    pub task_m: f64,
}

/// For each demonstration the one that moves most alike, by the tip's positions at equal phases; none for
/// a single demonstration.
pub fn nearest(demonstrations: &[&Demonstration], frame: &StateFrame) -> Vec<Option<Neighbour>> {
    const PHASES: usize = 25;
    let positions =
        |motion: &Motion| -> Vec<Isometry3<f64>> { frame.poses(&motion.states.resampled(PHASES)) };
    let paths: Vec<_> = demonstrations.iter().map(|d| positions(&d.motion)).collect();
    let rms = |a: &[Isometry3<f64>], b: &[Isometry3<f64>]| {
        let squares = a
            .iter()
            .zip(b)
            .map(|(a, b)| (a.translation.vector - b.translation.vector).norm_squared());
        (squares.sum::<f64>() / PHASES as f64).sqrt()
    };
    let neighbour = |i: usize| {
        let others = (0..paths.len()).filter(|j| *j != i);
        let distances = others.map(|j| (j, rms(&paths[i], &paths[j])));
        let (index, motion_m) = distances.min_by(|a, b| a.1.total_cmp(&b.1))?;
        let [a, b] = [i, index].map(|i| demonstrations[i].w.values());
        let apart = a.chunks(2).zip(b.chunks(2)).map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1]));
        Some(Neighbour { index, motion_m, task_m: apart.fold(0.0, f64::max) })
    };
    (0..paths.len()).map(neighbour).collect()
}
