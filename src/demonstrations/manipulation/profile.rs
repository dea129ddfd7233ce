//! What the measures of a motion have in common: its poses, tilts, and the times of its action.

use nalgebra::{Isometry3, Vector3};

use super::{Action, ManipulationTask};
use crate::pose::{tilt, up_in_tip};
use crate::trajectory::Motion;

/// One time that the action happens, in fractions of the index of the poses it was found in.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Happening {
    /// The intervals of the action; more than one where the tilt wavers about its threshold.
    intervals: Vec<[f64; 2]>,
}

impl Happening {
    pub(super) fn start(&self) -> f64 {
        self.intervals[0][0]
    }

    pub(super) fn end(&self) -> f64 {
        self.intervals[self.intervals.len() - 1][1]
    }
}

/// A motion's poses, tilts and actions.
#[derive(Debug, Clone)]
pub(super) struct Profile {
    pub(super) poses: Vec<Isometry3<f64>>,
    /// Tilt of the axis that points up in the first pose.
    pub(super) tilts_deg: Vec<f64>,
    pub(super) actions: Vec<Happening>,
    reached: f64,
}

impl ManipulationTask {
    pub(super) fn profile(&self, motion: &Motion) -> Profile {
        self.profile_of(self.state_frame().poses(&motion.states))
    }

    /// The profile of poses that are equally spaced in time, of which there is at least one.
    pub(super) fn profile_of(&self, poses: Vec<Isometry3<f64>>) -> Profile {
        let axis = up_in_tip(&poses[0]);
        let tilts_deg: Vec<f64> = poses.iter().map(|p| tilt(p, &axis).to_degrees()).collect();
        let (actions, reached) = match self.action {
            Action::Tilt { above_deg, same_above_deg, .. } => {
                let largest = tilts_deg.iter().copied().fold(0.0, f64::max);
                (tilted(&tilts_deg, above_deg, same_above_deg), largest)
            }
            Action::Carry { radius_m, least_m, .. } => carried(&poses, radius_m, least_m),
        };
        Profile { poses, tilts_deg, actions, reached }
    }
}

/// The times that the tilt is above a threshold.
fn tilted(tilts_deg: &[f64], above_deg: f64, same_above_deg: f64) -> Vec<Happening> {
    let mut actions: Vec<Happening> = Vec::new();
    for interval in above(tilts_deg, above_deg) {
        match actions.last_mut() {
            Some(action) => {
                let gap = action.end().ceil() as usize..=interval[0].floor() as usize;
                let least = tilts_deg[gap].iter().copied().fold(180.0, f64::min);
                if least < same_above_deg {
                    actions.push(Happening { intervals: vec![interval] });
                } else {
                    action.intervals.push(interval);
                }
            }
            None => actions.push(Happening { intervals: vec![interval] }),
        }
    }
    actions
}

/// The time from leaving the first place to arriving at the last one, if these are so far apart, and
/// how far they are.
fn carried(poses: &[Isometry3<f64>], radius_m: f64, least_m: f64) -> (Vec<Happening>, f64) {
    let distances = |from: &Isometry3<f64>| -> Vec<f64> {
        let place = from.translation.vector.xy();
        poses.iter().map(|p| (p.translation.vector.xy() - place).norm()).collect()
    };
    let last = &poses[poses.len() - 1];
    let (from_start, from_end) = (distances(&poses[0]), distances(last));
    let reached = from_end[0];
    let left = above(&from_start, radius_m).first().map(|interval| interval[0]);
    let arrived = above(&from_end, radius_m).last().map(|interval| interval[1]);
    let interval = left.zip(arrived).filter(|(left, arrived)| reached >= least_m && left < arrived);
    let action = interval.map(|(left, arrived)| Happening { intervals: vec![[left, arrived]] });
    (action.into_iter().collect(), reached)
}

impl Profile {
    pub(super) fn first(&self) -> &Isometry3<f64> {
        &self.poses[0]
    }

    pub(super) fn last(&self) -> &Isometry3<f64> {
        &self.poses[self.poses.len() - 1]
    }

    /// Whether the action happens, and for a time.
    pub(super) fn has_action(&self) -> bool {
        self.action_steps() > 0.0
    }

    /// How far the motion comes towards having the action: the largest tilt, degrees, or how far the
    /// object is carried, m.
    pub(super) fn reached(&self) -> f64 {
        self.reached
    }

    pub(super) fn maximum_tilt_deg(&self) -> f64 {
        self.tilts_deg.iter().copied().fold(0.0, f64::max)
    }

    /// Height of the tip above the start, on average over the time of the action.
    pub(super) fn lift_m(&self) -> f64 {
        self.mean_position_in_action().z - self.first().translation.z
    }

    /// Direction of the tip's z axis, which points out of a gripper, over the ground at the start;
    /// counted from the base's x axis.
    pub(super) fn heading_deg(&self) -> f64 {
        let forward = self.poses[0].rotation * Vector3::z();
        forward.y.atan2(forward.x).to_degrees()
    }

    /// Where the object leans when it is tilted most, as an angle between 0 degrees, where it rolls to
    /// the side of the hand to which it is carried, over 90, where it pitches ahead, to 180, where it
    /// rolls to the other side.
    pub(super) fn style_deg(&self) -> f64 {
        let most =
            (0..self.poses.len()).max_by(|a, b| self.tilts_deg[*a].total_cmp(&self.tilts_deg[*b]));
        let grasp = &self.poses[0];
        let turn = most.map(|i| self.poses[i].rotation * grasp.rotation.inverse());
        let axis = turn.map_or(Vector3::zeros(), |turn| turn.scaled_axis());
        // Tilted about the hand's heading a cup rolls to the right, about the opposite to the left.
        let from_right = axis.y.atan2(axis.x).to_degrees() - self.heading_deg();
        let ahead = grasp.rotation * Vector3::z();
        let way = self.mean_position_in_action() - grasp.translation.vector;
        let to_the_right = way.dot(&ahead.cross(&Vector3::z())) > 0.0;
        let style = if to_the_right { from_right } else { 180.0 - from_right };
        (style + 90.0).rem_euclid(360.0) - 90.0
    }

    /// Steps during which the action happens.
    pub(super) fn action_steps(&self) -> f64 {
        self.actions.iter().flat_map(|p| &p.intervals).map(|[a, b]| b - a).sum()
    }

    /// Mean position of the tip over the time of the action, moving linearly between poses.
    pub(super) fn mean_position_in_action(&self) -> Vector3<f64> {
        let mut sum = Vector3::zeros();
        for &[start, end] in self.actions.iter().flat_map(|p| &p.intervals) {
            // Between two poses the mean of the ends is the mean.
            let mut from = start;
            while from < end {
                let to = (from.floor() + 1.0).min(end);
                sum += (self.position(from) + self.position(to)) * (0.5 * (to - from));
                from = to;
            }
        }
        sum / self.action_steps()
    }

    /// Where the tip is at a fraction of the index.
    pub(super) fn position(&self, at: f64) -> Vector3<f64> {
        let i = (at.floor() as usize).min(self.poses.len() - 2);
        let [a, b] = [i, i + 1].map(|i| self.poses[i].translation.vector);
        a + (b - a) * (at - i as f64)
    }
}

/// Where values, interpolated linearly, are above a threshold: intervals of the fractional index.
fn above(values: &[f64], threshold: f64) -> Vec<[f64; 2]> {
    let mut intervals: Vec<[f64; 2]> = Vec::new();
    let mut start = values.first().filter(|&&v| v > threshold).map(|_| 0.0);
    for (i, pair) in values.windows(2).enumerate() {
        let crossing = || i as f64 + (threshold - pair[0]) / (pair[1] - pair[0]);
        match (start, pair[1] > threshold) {
            (None, true) => start = Some(crossing()),
            (Some(from), false) => {
                intervals.push([from, crossing()]);
                start = None;
            }
            _ => {}
        }
    }
    if let Some(from) = start {
        intervals.push([from, (values.len() - 1) as f64]);
    }
    intervals
}
