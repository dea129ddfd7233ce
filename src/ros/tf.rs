//! Where frames are, as `/tf` and `/tf_static` tell: the last ten seconds of each.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion};
use transforms::errors::RegistryError;
use transforms::geometry::{Quaternion as TfQuaternion, Transform, Vector3};
use transforms::time::{Stamp, Timestamp};
use transforms::{Registry, errors::TransformError};

use super::messages::builtin_interfaces::Time;
use super::messages::geometry_msgs::TransformStamped;

/// How long a transform that moves is kept, as tf2 keeps it.
pub const KEPT: Duration = Duration::from_secs(10);
/// Frames that are known at the same time, at most; a network may name more than any robot has.
const MOST_FRAMES: usize = 10_000;
/// Frames that an error names, at most.
const MOST_NAMED: usize = 12;
/// How far from 1 the norm of a rotation may be that counts as rounded.
const ROUNDED: f64 = 1e-2;

/// Why there is no transform.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum LookupError {
    /// Nobody told of the frame.
    #[error("{}", unknown(frame, known))]
    UnknownFrame {
        /// The frame.
        frame: String,
        /// The frames that are known, by their names.
        known: Vec<String>,
    },
    /// The frames are known, but not where one is in the other at that time.
    #[error("{0}")]
    NoTransform(String),
}

fn unknown(frame: &str, known: &[String]) -> String {
    match known {
        [] => format!("nothing is known of {frame:?}, since neither /tf nor /tf_static was heard"),
        known => format!(
            "nothing is known of {frame:?}; /tf and /tf_static tell of {}{}",
            known[..known.len().min(MOST_NAMED)].join(", "),
            match known.len().saturating_sub(MOST_NAMED) {
                0 => String::new(),
                more => format!(" and {more} more"),
            }
        ),
    }
}

/// The tree of frames.
#[derive(Debug)]
pub struct FrameTree {
    registry: Registry,
    /// The parent of each child that was heard of, and the newest time of those that move.
    edges: BTreeMap<String, Edge>,
    /// What was complained of, so that it is said once.
    told: BTreeSet<String>,
}

#[derive(Debug, Clone, PartialEq)]
struct Edge {
    parent: String,
    newest: Option<Timestamp>,
}

impl Default for FrameTree {
    fn default() -> Self {
        let registry = Registry::with_max_age(KEPT);
        Self { registry, edges: BTreeMap::new(), told: BTreeSet::new() }
    }
}

impl FrameTree {
    /// Takes note of a transform. A child that has another parent now, or turns from still to moving, or whose time
    /// goes back by more than is kept (a bag that begins again), begins anew.
    ///
    /// # Errors
    /// What is wrong with it, the first time that it is so.
    pub fn hear(&mut self, message: &TransformStamped, is_static: bool) -> Result<(), String> {
        let child = without_slash(&message.child_frame_id);
        self.take(message, is_static)
            .map_err(|e| format!("a transform of {child:?} is left out: {e}"))
            .or_else(|complaint| {
                match self.told.len() < MOST_FRAMES && self.told.insert(complaint.clone()) {
                    true => Err(complaint),
                    false => Ok(()),
                }
            })
    }

    fn take(&mut self, message: &TransformStamped, is_static: bool) -> Result<(), String> {
        let [parent, child] =
            [&message.header.frame_id, &message.child_frame_id].map(|id| without_slash(id));
        if parent.is_empty() || child.is_empty() {
            return Err("a frame without a name".into());
        }
        if parent == child {
            return Err("a frame can't be its own parent".into());
        }
        let stamp = match is_static {
            true => Stamp::Static,
            false => Stamp::At(timestamp(message.header.stamp).ok_or("its stamp is before 1970")?),
        };
        let transform = transform(message, parent, child, stamp)?;
        let newest = stamp.at();
        let known = self.edges.get(child);
        if known.is_none() && self.edges.len() >= MOST_FRAMES {
            return Err(format!("{MOST_FRAMES} frames are known already, and no more are kept"));
        }
        let begins_anew = known.is_some_and(|edge| {
            let goes_back = match (edge.newest, newest) {
                (Some(newest), Some(now)) => {
                    newest.as_nanos().saturating_sub(now.as_nanos()) > KEPT.as_nanos() as u64
                }
                (None, None) => false,
                _ => true,
            };
            edge.parent != parent || goes_back
        });
        if begins_anew && self.is_above(child, parent) {
            // Before anything of it is forgotten.
            return Err("it would close a circle".into());
        }
        if begins_anew {
            // What is below it stays: those edges are their own.
            let _ = self.registry.remove_frame(child);
            self.edges.remove(child);
        }
        self.registry.add_transform(transform).map_err(|e| e.to_string())?;
        let edge = self
            .edges
            .entry(child.to_owned())
            .or_insert_with(|| Edge { parent: parent.to_owned(), newest });
        edge.newest = edge.newest.max(newest);
        Ok(())
    }

    /// Takes a point of `source` to `target` at a time; stamp 0 means the latest time at which all of the way is known.
    ///
    /// # Errors
    /// A frame that nobody told of; frames that are not connected, or not at that time.
    pub fn point(
        &self,
        target: &str,
        source: &str,
        stamp: Time,
        point: Point3<f64>,
    ) -> Result<Point3<f64>, LookupError> {
        let [target, source] = [target, source].map(without_slash);
        let at = match stamp {
            Time { sec: 0, nanosec: 0 } => self
                .registry
                .latest_common_time(target, source)
                .map_err(|e| self.error(&e))?
                .at()
                .unwrap_or(Timestamp::zero()),
            stamp => timestamp(stamp).ok_or_else(|| {
                LookupError::NoTransform(format!("the stamp {} s is before 1970", stamp.sec))
            })?,
        };
        let found = self.registry.get_transform(target, source, at).map_err(|e| self.error(&e))?;
        let (t, r) = (found.translation(), found.rotation());
        let rotation = UnitQuaternion::new_normalize(Quaternion::new(r.w, r.x, r.y, r.z));
        Ok(Isometry3::from_parts(Translation3::new(t.x, t.y, t.z), rotation) * point)
    }

    /// The frames that are known, by their names.
    pub fn known(&self) -> Vec<String> {
        let frames = self.edges.iter().flat_map(|(child, edge)| [child, &edge.parent]);
        frames.collect::<BTreeSet<_>>().into_iter().cloned().collect()
    }

    /// Whether a frame is above another one, which hangs on it.
    fn is_above(&self, above: &str, frame: &str) -> bool {
        let parent = |frame: &&str| self.edges.get(*frame).map(|edge| edge.parent.as_str());
        // No way up is longer than there are edges.
        std::iter::successors(Some(frame), parent).take(self.edges.len() + 1).any(|f| f == above)
    }

    fn error(&self, error: &RegistryError) -> LookupError {
        let secs = |t: &Timestamp| t.as_seconds_lossy();
        LookupError::NoTransform(match error {
            RegistryError::UnknownFrame(frame) => {
                return LookupError::UnknownFrame { frame: frame.clone(), known: self.known() };
            }
            RegistryError::Disconnected { target_frame, source_frame } => format!(
                "{source_frame:?} and {target_frame:?} are known, but nothing connects them"
            ),
            RegistryError::NotFoundAt { frame, requested, covered: Some((from, to)), .. } => {
                format!(
                    "{frame:?} is known from {:.3} to {:.3} s, and asked for at {:.3} s; stamp 0 takes the \
                 latest",
                    secs(from),
                    secs(to),
                    secs(requested)
                )
            }
            RegistryError::NoCommonTime { frame, covered: Some((from, to)), .. } => format!(
                "{frame:?} is known from {:.3} to {:.3} s, when other frames on the way are not known",
                secs(from),
                secs(to)
            ),
            other => other.to_string(),
        })
    }
}

fn without_slash(id: &str) -> &str {
    id.strip_prefix('/').unwrap_or(id)
}

fn timestamp(Time { sec, nanosec }: Time) -> Option<Timestamp> {
    let secs = u64::try_from(sec).ok()?;
    Some(Timestamp::from_nanos(secs * 1_000_000_000 + u64::from(nanosec)))
}

fn transform(
    message: &TransformStamped,
    parent: &str,
    child: &str,
    stamp: Stamp,
) -> Result<Transform, String> {
    let (t, r) = (message.transform.translation, message.transform.rotation);
    let rotation = TfQuaternion::from_wxyz(r.w, r.x, r.y, r.z);
    let norm = rotation.norm();
    if (norm - 1.0).abs() > ROUNDED || norm.is_nan() {
        let norm = if norm < 1e6 { format!("{norm:.3}") } else { format!("{norm:.0e}") };
        return Err(format!("its rotation has the norm {norm}; a unit quaternion is needed"));
    }
    let rotation = rotation.normalize().map_err(|e| e.to_string())?;
    Transform::new(parent, child, Vector3::new(t.x, t.y, t.z), rotation, stamp)
        .map_err(|e: TransformError| e.to_string())
}

#[cfg(test)]
mod tests {
    use super::super::messages::geometry_msgs::{self, Quaternion};
    use super::super::messages::std_msgs::Header;
    use super::*;

    fn time(secs: f64) -> Time {
        Time { sec: secs.floor() as i32, nanosec: (secs.fract() * 1e9).round() as u32 }
    }

    /// `child` stands at x in `parent`, turned about z.
    fn edge(parent: &str, child: &str, x: f64, yaw: f64, secs: f64) -> TransformStamped {
        TransformStamped {
            header: Header { stamp: time(secs), frame_id: parent.into() },
            child_frame_id: child.into(),
            transform: geometry_msgs::Transform {
                translation: geometry_msgs::Vector3 { x, y: 0.0, z: 0.0 },
                rotation: Quaternion { x: 0.0, y: 0.0, z: (0.5 * yaw).sin(), w: (0.5 * yaw).cos() },
            },
        }
    }

    fn x_of(tree: &FrameTree, source: &str, secs: f64) -> Result<f64, LookupError> {
        tree.point("base", source, time(secs), Point3::origin()).map(|p| p.x)
    }

    #[test]
    fn a_point_goes_along_the_way_between_frames_both_up_and_down() {
        let mut tree = FrameTree::default();
        tree.hear(&edge("world", "base", 1.0, 0.0, 0.0), true).unwrap();
        tree.hear(&edge("world", "table", 2.0, std::f64::consts::FRAC_PI_2, 0.0), true).unwrap();
        tree.hear(&edge("/table", "cup", 0.5, 0.0, 5.0), false).unwrap();
        for stamp in [0.0, 5.0] {
            let p = tree.point("base", "cup", time(stamp), Point3::new(0.1, 0.0, 0.3)).unwrap();
            // 0.6 along the table's x, which is the base's y.
            assert!((p - Point3::new(1.0, 0.6, 0.3)).norm() < 1e-12, "{p}");
        }
        assert_eq!(tree.known(), ["base", "cup", "table", "world"]);
        let same = tree.point("base", "base", time(77.0), Point3::new(1.0, 2.0, 3.0)).unwrap();
        assert_eq!(same, Point3::new(1.0, 2.0, 3.0));
    }

    #[test]
    fn between_two_times_a_frame_is_between_two_places_and_outside_nowhere() {
        let mut tree = FrameTree::default();
        for (x, secs) in [(0.2, 10.0), (0.6, 11.0)] {
            tree.hear(&edge("base", "cup", x, 0.0, secs), false).unwrap();
        }
        assert!((x_of(&tree, "cup", 10.25).unwrap() - 0.3).abs() < 1e-9);
        assert_eq!(x_of(&tree, "cup", 0.0).unwrap(), 0.6);
        let error = x_of(&tree, "cup", 11.5).unwrap_err().to_string();
        assert!(error.contains("from 10.000 to 11.000 s, and asked for at 11.500 s"), "{error}");
    }

    #[test]
    fn frames_that_are_not_known_or_not_connected_are_named() {
        let mut tree = FrameTree::default();
        let error = x_of(&tree, "cup", 0.0).unwrap_err();
        assert!(matches!(&error, LookupError::UnknownFrame { .. }), "{error}");
        tree.hear(&edge("base", "hand", 0.1, 0.0, 1.0), false).unwrap();
        tree.hear(&edge("camera", "cup", 0.1, 0.0, 1.0), false).unwrap();
        let error = x_of(&tree, "mug", 0.0).unwrap_err().to_string();
        assert_eq!(
            error,
            "nothing is known of \"mug\"; /tf and /tf_static tell of base, camera, cup, hand"
        );
        let error = x_of(&tree, "cup", 0.0).unwrap_err().to_string();
        assert!(error.contains("nothing connects them"), "{error}");
    }

    #[test]
    fn another_parent_or_a_bag_from_its_beginning_begin_anew() {
        let mut tree = FrameTree::default();
        tree.hear(&edge("base", "hand", 1.0, 0.0, 100.0), false).unwrap();
        tree.hear(&edge("base", "cup", 0.1, 0.0, 100.0), false).unwrap();
        tree.hear(&edge("hand", "cup", 0.1, 0.0, 101.0), false).unwrap();
        assert!(x_of(&tree, "cup", 0.0).is_err(), "the hand was not seen so late");
        tree.hear(&edge("base", "hand", 1.0, 0.0, 102.0), false).unwrap();
        assert!((x_of(&tree, "cup", 0.0).unwrap() - 1.1).abs() < 1e-12);
        for secs in [2.0, 3.0] {
            tree.hear(&edge("base", "hand", secs, 0.0, secs), false).unwrap();
            tree.hear(&edge("hand", "cup", 0.1, 0.0, secs), false).unwrap();
        }
        assert!((x_of(&tree, "cup", 2.5).unwrap() - 2.6).abs() < 1e-9);
        // Late by less than is kept: it is one more place in between.
        tree.hear(&edge("base", "hand", 2.9, 0.0, 2.5), false).unwrap();
        assert!((x_of(&tree, "cup", 2.5).unwrap() - 3.0).abs() < 1e-9);
    }

    #[test]
    fn what_is_no_transform_is_left_out_and_told_once() {
        let mut tree = FrameTree::default();
        let mut not_unit = edge("base", "cup", 0.1, 0.0, 1.0);
        not_unit.transform.rotation.w = 0.0;
        let cases = [
            not_unit,
            edge("base", "cup", f64::NAN, 0.0, 1.0),
            edge("cup", "cup", 0.1, 0.0, 1.0),
            edge("", "cup", 0.1, 0.0, 1.0),
            edge("base", "cup", 0.1, 0.0, -1.0),
        ];
        for case in cases {
            assert!(tree.hear(&case, false).is_err(), "{case:?}");
            assert_eq!(tree.hear(&case, false), Ok(()), "told once: {case:?}");
        }
        assert!(tree.known().is_empty());
        tree.hear(&edge("base", "cup", 0.1, 0.0, 1.0), false).unwrap();
        assert!(tree.hear(&edge("cup", "base", 0.1, 0.0, 1.0), false).is_err(), "a circle");
        tree.hear(&edge("cup", "spoon", 0.1, 0.0, 1.0), false).unwrap();
        for is_static in [false, true] {
            let circle = edge("spoon", "cup", 0.1, 0.0, 1.0);
            let error = tree.hear(&circle, is_static);
            assert!(is_static || error.unwrap_err().contains("circle"));
        }
        assert_eq!(x_of(&tree, "cup", 0.0).unwrap(), 0.1);
    }

    #[test]
    fn no_flood_of_names_fills_the_memory() {
        let mut tree = FrameTree::default();
        for i in 0..MOST_FRAMES + 100 {
            let _ = tree.hear(&edge("base", &format!("frame{i}"), 0.1, 0.0, 1.0), false);
        }
        assert_eq!(tree.known().len(), MOST_FRAMES + 1);
        assert!(tree.told.len() <= MOST_FRAMES);
        let error = x_of(&tree, "mug", 0.0).unwrap_err().to_string();
        assert!(error.ends_with("and 9989 more"), "{error}");
    }
}
