//! Between the messages on the wire and the core's types.

use nalgebra::{Isometry3, Point3};

use super::messages::builtin_interfaces::{Duration, Time};
use super::messages::geometry_msgs::{
    Point, PointStamped, Pose, PoseStamped, Quaternion, Transform, Vector3,
};
use super::messages::nav_msgs::Path;
use super::messages::std_msgs::Header;
use super::messages::{tcvae_msgs, trajectory_msgs};
use super::tf::{FrameTree, LookupError};
use crate::parameters::MannerAxis;
use crate::serving::{
    Description, ErrorCode, GivenLocation, RankBy, Refusal, Sample, SampleReply, SampleRequest,
};
use crate::trajectory::{EndEffectorTrajectory, JointTrajectory};

/// The frames that messages are given in.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frames {
    /// Frame of all positions.
    pub base: String,
    /// Frame that moves.
    pub tip: String,
}

impl Frames {
    /// The place of a point in the plane of the base frame; its height has no meaning for a task.
    ///
    /// # Errors
    /// [`ErrorCode::FrameUnknown`] for a frame that is empty or that nobody told of,
    /// [`ErrorCode::TransformFailed`] where it is not known how to get from there to the base.
    pub fn location(
        &self,
        tree: &FrameTree,
        name: &str,
        header: &Header,
        point: &Point,
    ) -> Result<GivenLocation, Refusal> {
        let (base, frame) = (&self.base, &header.frame_id);
        let xy = if frame == base {
            [point.x, point.y]
        } else if frame.is_empty() {
            return Err(Refusal::new(
                ErrorCode::FrameUnknown,
                format!(
                    "{name} has an empty header.frame_id; give the point in {base:?}, or in another frame"
                ),
            ));
        } else {
            let there = Point3::new(point.x, point.y, point.z);
            let here = tree.point(base, frame, header.stamp, there).map_err(|error| {
                let code = match error {
                    LookupError::UnknownFrame { .. } => ErrorCode::FrameUnknown,
                    LookupError::NoTransform(_) => ErrorCode::TransformFailed,
                };
                let fact = format!("{name} is given in the frame {frame:?}: {error}");
                Refusal::new(
                    code,
                    format!("{fact}; publish its transform, or give the point in {base:?}"),
                )
            })?;
            [here.x, here.y]
        };
        Ok(GivenLocation { name: name.into(), xy })
    }

    /// The core's form of a request.
    ///
    /// # Errors
    /// As [`Self::location`]; [`ErrorCode::BadRequest`] for lists of different lengths and an unknown order.
    pub fn request(
        &self,
        tree: &FrameTree,
        message: tcvae_msgs::SampleTrajectoryRequest,
    ) -> Result<SampleRequest, Refusal> {
        let tcvae_msgs::SampleTrajectoryRequest {
            task,
            manner_names,
            manner_values,
            sample_manner,
            count,
            seed,
            start,
            velocity_scale,
            acceleration_scale,
            rate_hz,
            rank_by,
            publish: _,
            allow_out_of_distribution,
        } = message;
        let location = |t: &tcvae_msgs::TaskLocation| {
            self.location(tree, &t.name, &t.point.header, &t.point.point)
        };
        let task = task.iter().map(location);
        if start.name.len() != start.position.len() {
            return Err(bad_request(format!(
                "start names {} joints and has {} positions; give one position for each name",
                start.name.len(),
                start.position.len()
            )));
        }
        let rank_by = match rank_by.as_str() {
            "" => RankBy::Drawn,
            "margin" => RankBy::Margin,
            "smoothness" => RankBy::Smoothness,
            "duration" => RankBy::Duration,
            other => {
                return Err(bad_request(format!(
                    "rank_by is {other:?}; it is empty, margin, smoothness or duration"
                )));
            }
        };
        Ok(SampleRequest {
            task: task.collect::<Result<_, _>>()?,
            manner_names,
            manner_values,
            sample_manner,
            count,
            seed,
            start: start.name.into_iter().zip(start.position).collect(),
            start_policy: None,
            is_driven: false,
            velocity_scale,
            acceleration_scale,
            speed: 0.0,
            rate_hz,
            rank_by,
            allow_out_of_distribution,
        })
    }

    /// The answer to a request.
    pub fn response(&self, reply: SampleReply) -> tcvae_msgs::SampleTrajectoryResponse {
        let (error_code, error_message) = error(reply.refusal.as_ref());
        tcvae_msgs::SampleTrajectoryResponse {
            error_code,
            error_message,
            samples: reply.samples.iter().map(|sample| self.sample(sample)).collect(),
            model_id: reply.model_id,
        }
    }

    /// A sample as a message.
    pub fn sample(&self, sample: &Sample) -> tcvae_msgs::Sample {
        let Sample {
            joint_trajectory,
            end_effector_trajectory,
            primitive_start_index,
            manner_names,
            manner_values,
            task: _,
            empirical_task,
            task_error,
            position_error,
            orientation_error,
            joint_margin,
            min_clearance,
            slowdown,
            in_distribution_task,
            in_distribution_manner,
            position_stddev,
            seed,
            tries,
            warnings,
        } = sample.clone();
        let location = |location: GivenLocation| tcvae_msgs::TaskLocation {
            name: location.name,
            point: PointStamped {
                header: self.header(Time::default()),
                point: Point { x: location.xy[0], y: location.xy[1], z: 0.0 },
            },
        };
        tcvae_msgs::Sample {
            joint_trajectory: self.joint_trajectory(&joint_trajectory),
            end_effector_trajectory: self.end_effector_trajectory(&end_effector_trajectory),
            primitive_start_index,
            manner_names,
            manner_values,
            empirical_task: empirical_task.into_iter().map(location).collect(),
            task_error,
            position_error,
            orientation_error,
            joint_margin,
            min_clearance,
            slowdown,
            in_distribution_task,
            in_distribution_manner,
            position_stddev,
            seed,
            tries,
            warnings,
        }
    }

    /// The trajectory that a joint trajectory controller follows at once (stamp 0).
    pub fn joint_trajectory(&self, joints: &JointTrajectory) -> trajectory_msgs::JointTrajectory {
        let point = |(i, time): (usize, &f64)| trajectory_msgs::JointTrajectoryPoint {
            positions: joints.positions[i].clone(),
            velocities: joints.velocities[i].clone(),
            accelerations: joints.accelerations[i].clone(),
            effort: Vec::new(),
            time_from_start: Duration::from_secs_f64(*time),
        };
        trajectory_msgs::JointTrajectory {
            header: self.header(Time::default()),
            joint_names: joints.joint_names.clone(),
            points: joints.times_secs.iter().enumerate().map(point).collect(),
        }
    }

    /// The same motion as timed poses of the tip.
    pub fn end_effector_trajectory(
        &self,
        poses: &EndEffectorTrajectory,
    ) -> trajectory_msgs::MultiDOFJointTrajectory {
        let point = |(time, base_from_tip): (&f64, &Isometry3<f64>)| {
            let Pose { position: Point { x, y, z }, orientation } = pose(base_from_tip);
            trajectory_msgs::MultiDOFJointTrajectoryPoint {
                transforms: vec![Transform {
                    translation: Vector3 { x, y, z },
                    rotation: orientation,
                }],
                velocities: Vec::new(),
                accelerations: Vec::new(),
                time_from_start: Duration::from_secs_f64(*time),
            }
        };
        trajectory_msgs::MultiDOFJointTrajectory {
            header: self.header(Time::default()),
            joint_names: vec![self.tip.clone()],
            points: poses.times_secs.iter().zip(&poses.base_from_tip).map(point).collect(),
        }
    }

    /// The same motion as a path to look at.
    pub fn path(&self, poses: &EndEffectorTrajectory, stamp: Time) -> Path {
        let header = self.header(stamp);
        let stamped =
            |base_from_tip| PoseStamped { header: header.clone(), pose: pose(base_from_tip) };
        Path { poses: poses.base_from_tip.iter().map(stamped).collect(), header: header.clone() }
    }

    fn header(&self, stamp: Time) -> Header {
        Header { stamp, frame_id: self.base.clone() }
    }
}

/// The manner parameters and their values.
pub fn manner(axes: &[MannerAxis], values: &[f64]) -> Vec<tcvae_msgs::MannerParameter> {
    let parameter = |(axis, value): (&MannerAxis, &f64)| {
        let MannerAxis { name, lower, upper, effect } = axis.clone();
        tcvae_msgs::MannerParameter { name, value: *value, lower, upper, effect }
    };
    axes.iter().zip(values).map(parameter).collect()
}

/// What is served, as the service answers it.
pub fn description(description: Description) -> tcvae_msgs::DescribePrimitiveResponse {
    let Description {
        model_id,
        method: _,
        primitive,
        task_names,
        task_lower,
        task_upper,
        manner: axes,
        manner_values,
        evaluation_json,
        robot,
        joint_names,
        synthetic_data,
        mirrored: _,
    } = description;
    tcvae_msgs::DescribePrimitiveResponse {
        model_id,
        primitive,
        task_names,
        task_lower,
        task_upper,
        manner: manner(&axes, &manner_values),
        evaluation_json,
        robot,
        joint_names,
        synthetic_data,
    }
}

/// What is served, as `~/model_info` publishes it.
pub fn model_info(description: &Description, frames: &Frames) -> String {
    let evaluation: serde_json::Value =
        serde_json::from_str(&description.evaluation_json).unwrap_or_default();
    let location = |((name, lower), upper): ((&String, &f64), &f64)| serde_json::json!({"name": name, "lower": lower, "upper": upper});
    let task = description.task_names.iter().zip(&description.task_lower);
    serde_json::json!({
        "model_id": description.model_id,
        "primitive": description.primitive,
        "method": description.method,
        "synthetic_data": description.synthetic_data,
        "robot": description.robot,
        "mirrored": description.mirrored,
        "base_frame": frames.base,
        "tip_link": frames.tip,
        "joint_names": description.joint_names,
        "task": task.zip(&description.task_upper).map(location).collect::<Vec<_>>(),
        "manner": description.manner,
        "evaluation": evaluation,
    })
    .to_string()
}

/// The code and the message of an answer.
pub fn error(refusal: Option<&Refusal>) -> (i32, String) {
    match refusal {
        None => (ErrorCode::Ok as i32, String::new()),
        Some(refusal) => (refusal.code as i32, refusal.message.clone()),
    }
}

fn pose(base_from_tip: &Isometry3<f64>) -> Pose {
    let (p, q) = (base_from_tip.translation.vector, base_from_tip.rotation);
    Pose {
        position: Point { x: p.x, y: p.y, z: p.z },
        orientation: Quaternion { x: q.i, y: q.j, z: q.k, w: q.w },
    }
}

fn bad_request(message: String) -> Refusal {
    Refusal::new(ErrorCode::BadRequest, message)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::messages::sensor_msgs::JointState;
    use crate::ros::messages::tcvae_msgs::{SampleTrajectoryRequest, TaskLocation};

    fn frames() -> Frames {
        Frames { base: "base".into(), tip: "left_gripper".into() }
    }

    fn in_frame(frame: &str) -> TaskLocation {
        let header = Header { frame_id: frame.into(), ..Header::default() };
        let point = PointStamped { header, point: Point { x: 0.6, y: 0.2, z: 9.0 } };
        TaskLocation { name: "pour_location".into(), point }
    }

    #[test]
    fn a_point_in_the_base_frame_is_a_location_whatever_its_height() {
        let request = SampleTrajectoryRequest { task: vec![in_frame("base")], ..<_>::default() };
        let location = GivenLocation { name: "pour_location".into(), xy: [0.6, 0.2] };
        assert_eq!(frames().request(&FrameTree::default(), request).unwrap().task, [location]);
    }

    #[test]
    fn another_frame_is_refused_with_the_one_that_is_known() {
        for (frame, fact) in [("", "an empty header.frame_id"), ("camera", "\"camera\"")] {
            let request = SampleTrajectoryRequest { task: vec![in_frame(frame)], ..<_>::default() };
            let refusal = frames().request(&FrameTree::default(), request).unwrap_err();
            assert_eq!(refusal.code, ErrorCode::FrameUnknown);
            assert!(refusal.message.contains(fact), "{refusal}");
            assert!(refusal.message.contains("\"base\""), "{refusal}");
        }
    }

    #[test]
    fn an_unknown_order_and_a_start_of_two_lengths_are_bad_requests() {
        let start = JointState { name: vec!["a".into()], ..<_>::default() };
        for request in [
            SampleTrajectoryRequest { rank_by: "best".into(), ..<_>::default() },
            SampleTrajectoryRequest { start, ..<_>::default() },
        ] {
            assert_eq!(
                frames().request(&FrameTree::default(), request).unwrap_err().code,
                ErrorCode::BadRequest
            );
        }
    }

    #[test]
    fn a_trajectory_keeps_its_times_and_starts_at_once() {
        let joints = JointTrajectory {
            joint_names: vec!["a".into(), "b".into()],
            times_secs: vec![0.1, 2.25],
            positions: vec![vec![1.0, 2.0], vec![3.0, 4.0]],
            velocities: vec![vec![0.5, 0.5], vec![0.0, 0.0]],
            accelerations: vec![vec![0.1, 0.2], vec![0.3, 0.4]],
        };
        let message = frames().joint_trajectory(&joints);
        assert_eq!(message.header.stamp, Time::default());
        assert_eq!(message.points[1].time_from_start, Duration { sec: 2, nanosec: 250_000_000 });
        assert_eq!(message.points[0].positions, [1.0, 2.0]);
        assert_eq!(message.points[1].velocities, [0.0, 0.0]);
        assert_eq!(message.points[1].accelerations, [0.3, 0.4]);
    }

    #[test]
    fn a_pose_keeps_place_and_turn() {
        let turn = nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.0, std::f64::consts::PI);
        let base_from_tip = Isometry3::from_parts(nalgebra::Translation3::new(1.0, 2.0, 3.0), turn);
        let poses =
            EndEffectorTrajectory { times_secs: vec![0.5], base_from_tip: vec![base_from_tip] };
        let transform = frames().end_effector_trajectory(&poses).points[0].transforms[0];
        assert_eq!((transform.translation.x, transform.translation.z), (1.0, 3.0));
        assert!((transform.rotation.z.abs() - 1.0).abs() < 1e-12);
        let path = frames().path(&poses, Time { sec: 7, nanosec: 0 });
        assert_eq!(path.poses[0].pose.position.y, 2.0);
        assert_eq!(path.header.stamp.sec, 7);
    }
}
