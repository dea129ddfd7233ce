//! Robot descriptions (URDF) into the [`Chain`] between two of their frames.
//!
//! Only the way from the base to the tip is looked at. What else a file has (meshes that are not
//! there, transmissions, simulator tags, other limbs, a joint with a link's name) is not a reason
//! to refuse it.

use nalgebra::{Isometry3, Point3, Translation3, Unit, UnitQuaternion, Vector3};
use urdf_rs::{Geometry, JointType};

use crate::kinematics::{
    ArmDescription, Capsule, Chain, ChainError, Joint, JointKind, LinkPlace, Mimic,
};

/// Why a robot description has no chain between the two frames.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum UrdfError {
    /// The text is not a URDF file.
    #[error("this is not a robot description (URDF): {0}")]
    Parse(#[source] urdf_rs::UrdfError),
    /// A frame that the file does not have.
    #[error("the robot description {robot:?} has no link {frame:?} (the {role}); it has: {links}")]
    UnknownFrame {
        /// Name of the robot.
        robot: String,
        /// The frame.
        frame: String,
        /// What the frame is for: `base frame` or `tip link`.
        role: &'static str,
        /// Names of the links that are there, comma-separated.
        links: String,
    },
    /// The tip does not hang on the base.
    #[error(
        "the tip link {tip:?} does not hang on the base frame {base:?}; upwards of it are: {above}"
    )]
    NotConnected {
        /// The base frame.
        base: String,
        /// The tip link.
        tip: String,
        /// The links from the tip up to its root, comma-separated.
        above: String,
    },
    /// A link on the way that is the child of two joints.
    #[error("the link {link:?} is the child of two joints, {first:?} and {second:?}")]
    TwoParents {
        /// The link.
        link: String,
        /// One joint.
        first: String,
        /// The other joint.
        second: String,
    },
    /// Links that hang on each other in a circle.
    #[error("the links above {tip:?} form a circle through {link:?}")]
    Circle {
        /// The tip link.
        tip: String,
        /// A link of the circle.
        link: String,
    },
    /// A joint on the way that this crate does not move.
    #[error(
        "joint {joint:?} on the way to {tip:?} is {kind}; only fixed, revolute, continuous and \
         prismatic joints are supported there"
    )]
    Unsupported {
        /// Name of the joint.
        joint: String,
        /// The tip link.
        tip: String,
        /// What it is, such as `floating`.
        kind: String,
    },
    /// The joints on the way are no chain.
    #[error(transparent)]
    Chain(#[from] ChainError),
}

/// The chain from the link `base` to the link `tip`.
///
/// # Errors
/// Text that is not URDF, frames that are not in it, a tip that does not hang on the base, a joint
/// on the way that floats, mimics one that is not, or has no usable limits.
pub fn chain(urdf_xml: &str, base: &str, tip: &str) -> Result<Chain, UrdfError> {
    Ok(arm(urdf_xml, base, tip)?.chain)
}

/// The arm from the link `base` to the link `tip`, with the shape that the description's `<collision>`
/// elements give it: spheres and capsules as they are, a cylinder and a box as the capsule around it (along
/// the cylinder's axis, or the box's longest edge, over its whole length). Meshes are not read.
///
/// # Errors
/// As [`chain`].
pub fn arm(urdf_xml: &str, base: &str, tip: &str) -> Result<ArmDescription, UrdfError> {
    let robot = urdf_rs::read_from_string(urdf_xml).map_err(UrdfError::Parse)?;
    for (frame, role) in [(base, "base frame"), (tip, "tip link")] {
        if !robot.links.iter().any(|l| l.name == frame) {
            let links: Vec<_> = robot.links.iter().map(|l| l.name.as_str()).collect();
            return Err(UrdfError::UnknownFrame {
                robot: robot.name.clone(),
                frame: frame.into(),
                role,
                links: links.join(", "),
            });
        }
    }

    let mut joints = Vec::new();
    let mut links = vec![LinkPlace::new(base, 0, Isometry3::identity())];
    // Fixed joints met since the last moving one are folded into the next.
    let mut parent_from_here = Isometry3::identity();
    for joint in path(&robot, base, tip)? {
        parent_from_here *= isometry(&joint.origin);
        if joint.joint_type == JointType::Fixed {
            links.push(LinkPlace::new(&joint.child.link, joints.len(), parent_from_here));
            continue;
        }
        links.push(LinkPlace::new(&joint.child.link, joints.len() + 1, Isometry3::identity()));
        let kind = kind(joint, tip)?;
        let [x, y, z] = joint.axis.xyz.0;
        let axis = Unit::try_new(Vector3::new(x, y, z), 1e-9)
            .ok_or_else(|| ChainError::Geometry { joint: joint.name.clone() })?;
        let (lower, upper) = match kind {
            JointKind::Continuous => (f64::NEG_INFINITY, f64::INFINITY),
            _ => (joint.limit.lower, joint.limit.upper),
        };
        let acceleration = joint.limit.acceleration;
        joints.push(Joint {
            name: joint.name.clone(),
            kind,
            parent_from_joint: std::mem::replace(&mut parent_from_here, Isometry3::identity()),
            axis,
            lower,
            upper,
            velocity: joint.limit.velocity,
            acceleration: acceleration.is_finite().then_some(acceleration),
            jerk: joint.limit.jerk.is_finite().then_some(joint.limit.jerk),
            mimic: joint.mimic.as_ref().map(|mimic| Mimic {
                joint: mimic.joint.clone(),
                multiplier: mimic.multiplier.unwrap_or(1.0),
                offset: mimic.offset.unwrap_or(0.0),
            }),
        });
    }
    let chain = Chain::new(base, tip, joints, parent_from_here)?;
    place_neighbours(&robot, &mut links);
    let (parts, unmodelled) = shape(&robot, &links);
    let others = robot.joints.iter().filter(|joint| {
        let moves = !matches!(joint.joint_type, JointType::Fixed);
        moves && joint.mimic.is_none() && chain.joints().iter().all(|own| own.name != joint.name)
    });
    let rest = |joint: &urdf_rs::Joint| match joint.joint_type {
        JointType::Revolute | JointType::Prismatic if joint.limit.lower <= joint.limit.upper => {
            0f64.clamp(joint.limit.lower, joint.limit.upper)
        }
        _ => 0.0,
    };
    let others = others.map(|joint| (joint.name.clone(), rest(joint))).collect();
    Ok(ArmDescription { name: robot.name, chain, links, parts, others, unmodelled })
}

/// Adds the links that fixed joints hold on those that are placed, and on what they hold.
fn place_neighbours(robot: &urdf_rs::Robot, links: &mut Vec<LinkPlace>) {
    let mut next = 0;
    while next < links.len() {
        let here = links[next].clone();
        next += 1;
        for joint in robot.joints.iter().filter(|j| j.joint_type == JointType::Fixed) {
            let origin = isometry(&joint.origin);
            let beside = match (&joint.parent.link, &joint.child.link) {
                (parent, child) if *parent == here.name => (child, here.body_from_link * origin),
                // Upwards from the base, which need not be the description's root.
                (parent, child) if *child == here.name => {
                    (parent, here.body_from_link * origin.inverse())
                }
                _ => continue,
            };
            if links.iter().all(|l| l.name != *beside.0) {
                links.push(LinkPlace::new(beside.0, here.body, beside.1));
            }
        }
    }
}

/// The capsules of the links that are placed, and the links whose shape is not modelled.
fn shape(robot: &urdf_rs::Robot, links: &[LinkPlace]) -> (Vec<Capsule>, Vec<String>) {
    let (mut parts, mut unmodelled) = (Vec::new(), Vec::new());
    for link in robot.links.iter().filter(|link| !link.collision.is_empty()) {
        let mut modelled = true;
        for collision in &link.collision {
            let place = links.iter().find(|place| place.name == link.name);
            let Some((place, (half, radius))) = place.zip(capsule(&collision.geometry)) else {
                modelled = false;
                continue;
            };
            let body_from_shape = place.body_from_link * isometry(&collision.origin);
            let [from, to] = [-half, half].map(|end| body_from_shape * Point3::from(end));
            let finite = |p: &Point3<f64>| p.coords.iter().all(|v| v.is_finite());
            if finite(&from) && finite(&to) && radius.is_finite() && radius > 0.0 {
                parts.push(Capsule { link: link.name.clone(), body: place.body, from, to, radius });
            } else {
                modelled = false;
            }
        }
        if !modelled {
            unmodelled.push(link.name.clone());
        }
    }
    (parts, unmodelled)
}

/// Half the segment of the capsule around a shape, and the capsule's radius.
fn capsule(geometry: &Geometry) -> Option<(Vector3<f64>, f64)> {
    match *geometry {
        Geometry::Sphere { radius } => Some((Vector3::zeros(), radius)),
        Geometry::Cylinder { radius, length } | Geometry::Capsule { radius, length } => {
            Some((Vector3::new(0.0, 0.0, 0.5 * length), radius))
        }
        Geometry::Box { size } => {
            let half = 0.5 * Vector3::from(size.0);
            let longest = half.imax();
            let mut segment = Vector3::zeros();
            segment[longest] = half[longest];
            Some((segment, (half - segment).norm()))
        }
        Geometry::Mesh { .. } => None,
    }
}

/// The joints from `base` to `tip`, in that order.
fn path<'a>(
    robot: &'a urdf_rs::Robot,
    base: &str,
    tip: &str,
) -> Result<Vec<&'a urdf_rs::Joint>, UrdfError> {
    let mut joints: Vec<&urdf_rs::Joint> = Vec::new();
    let mut link = tip;
    while link != base {
        let mut parents = robot.joints.iter().filter(|j| j.child.link == link);
        let Some(joint) = parents.next() else {
            let above: Vec<_> = joints.iter().map(|j| &*j.parent.link).collect();
            return Err(UrdfError::NotConnected {
                base: base.into(),
                tip: tip.into(),
                above: if above.is_empty() { "none".into() } else { above.join(", ") },
            });
        };
        if let Some(second) = parents.next() {
            return Err(UrdfError::TwoParents {
                link: link.into(),
                first: joint.name.clone(),
                second: second.name.clone(),
            });
        }
        if joints.len() == robot.joints.len() {
            return Err(UrdfError::Circle { tip: tip.into(), link: link.into() });
        }
        joints.push(joint);
        link = &joint.parent.link;
    }
    joints.reverse();
    Ok(joints)
}

fn kind(joint: &urdf_rs::Joint, tip: &str) -> Result<JointKind, UrdfError> {
    let unsupported =
        |kind: String| UrdfError::Unsupported { joint: joint.name.clone(), tip: tip.into(), kind };
    match joint.joint_type {
        JointType::Revolute => Ok(JointKind::Revolute),
        JointType::Continuous => Ok(JointKind::Continuous),
        JointType::Prismatic => Ok(JointKind::Prismatic),
        JointType::Floating => Err(unsupported("floating".into())),
        JointType::Planar => Err(unsupported("planar".into())),
        JointType::Spherical => Err(unsupported("spherical".into())),
        JointType::Fixed => unreachable!("fixed joints are folded before"),
    }
}

/// A URDF origin: roll, pitch and yaw are turns about the fixed x, y and z, in this order.
fn isometry(origin: &urdf_rs::Pose) -> Isometry3<f64> {
    let [x, y, z] = origin.xyz.0;
    let [roll, pitch, yaw] = origin.rpy.0;
    Isometry3::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_euler_angles(roll, pitch, yaw),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kinematics::{CollisionRules, PartRule};

    /// A robot with one moving joint in each of several branches.
    fn robot(joints: &str) -> String {
        let links: String =
            ["base", "arm", "tool", "lamp"].map(|n| format!("<link name='{n}'/>")).concat();
        format!("<robot name='lathe'>{links}{joints}</robot>")
    }

    fn joint(kind: &str, parent: &str, child: &str, rest: &str) -> String {
        format!(
            "<joint name='to_{child}' type='{kind}'><parent link='{parent}'/>\
             <child link='{child}'/>{rest}</joint>"
        )
    }

    const LIMIT: &str = "<limit lower='-1' upper='2' effort='1' velocity='3'/>";

    fn refusal(xml: &str, base: &str, tip: &str) -> String {
        chain(xml, base, tip).unwrap_err().to_string()
    }

    #[test]
    fn text_that_is_no_urdf_is_refused() {
        for text in ["", "model: 3", "<robot", "<sdf version='1.6'><model name='x'/></sdf>"] {
            assert!(chain(text, "base", "tool").is_err(), "{text:?}");
        }
        assert!(refusal("<robot", "base", "tool").starts_with("this is not a robot description"));
    }

    #[test]
    fn a_frame_that_is_not_there_is_named_with_those_that_are() {
        let xml = robot(&joint("revolute", "base", "tool", LIMIT));
        let message = refusal(&xml, "base", "left_gripper");
        assert!(message.contains("\"left_gripper\" (the tip link)"), "{message}");
        assert!(message.ends_with("it has: base, arm, tool, lamp"), "{message}");
        assert!(refusal(&xml, "world", "tool").contains("\"world\" (the base frame)"));
    }

    #[test]
    fn a_tip_that_does_not_hang_on_the_base_is_refused() {
        let xml = robot(
            &[joint("revolute", "base", "arm", LIMIT), joint("revolute", "lamp", "tool", LIMIT)]
                .concat(),
        );
        let message = refusal(&xml, "base", "tool");
        assert!(message.ends_with("upwards of it are: lamp"), "{message}");
        assert!(refusal(&xml, "arm", "base").ends_with("upwards of it are: none"));
    }

    #[test]
    fn links_in_a_circle_are_refused() {
        let xml = robot(
            &[joint("revolute", "arm", "tool", LIMIT), joint("revolute", "tool", "arm", LIMIT)]
                .concat(),
        );
        assert!(matches!(chain(&xml, "base", "tool"), Err(UrdfError::Circle { .. })));
    }

    #[test]
    fn a_link_with_two_parents_is_refused_only_on_the_way() {
        let twice = [
            joint("revolute", "base", "arm", LIMIT),
            joint("revolute", "arm", "tool", LIMIT),
            joint("revolute", "base", "lamp", LIMIT),
            joint("revolute", "arm", "lamp", LIMIT),
        ];
        let xml = robot(&twice.concat());
        assert!(chain(&xml, "base", "tool").is_ok());
        assert!(matches!(chain(&xml, "base", "lamp"), Err(UrdfError::TwoParents { .. })));
    }

    #[test]
    fn joints_that_do_not_move_on_their_own_are_refused_on_the_way() {
        for kind in ["floating", "planar", "spherical"] {
            let xml = robot(&joint(kind, "base", "tool", LIMIT));
            assert!(refusal(&xml, "base", "tool").contains(&format!("is {kind};")));
        }
    }

    #[test]
    fn a_mimic_follows_a_joint_on_the_way_and_no_other() {
        let mimic = |of: &str| [LIMIT, &format!("<mimic joint='{of}' multiplier='2'/>")].concat();
        let xml = |of: &str| {
            let joints = [
                joint("revolute", "base", "arm", LIMIT),
                joint("revolute", "arm", "tool", &mimic(of)),
            ];
            robot(&joints.concat())
        };
        let arm = chain(&xml("to_arm"), "base", "tool").unwrap();
        // -1 to 2, and half of it.
        assert_eq!((arm.dof(), arm.joints()[0].lower, arm.joints()[0].upper), (1, -0.5, 1.0));
        assert!((arm.forward(&[0.3]).rotation.angle() - 0.9).abs() < 1e-12);
        assert!(refusal(&xml("to_lamp"), "base", "tool").contains("is a mimic of \"to_lamp\""));
        assert!(refusal(&xml("to_tool"), "base", "tool").contains("is a mimic of \"to_tool\""));
    }

    #[test]
    fn limits_that_are_missing_or_leave_no_room_are_refused_by_name() {
        let refused = |limit: &str| {
            let xml = robot(&joint("revolute", "base", "tool", limit));
            refusal(&xml, "base", "tool")
        };
        assert!(refused("").contains("\"to_tool\" has position limits 0 to 0"));
        let swapped = refused("<limit lower='2' upper='-1' effort='1' velocity='3'/>");
        assert!(swapped.contains("position limits 2 to -1"));
        let still = refused("<limit lower='-1' upper='2' effort='1' velocity='0'/>");
        assert!(still.contains("velocity limit 0"));
        for strange in ["nan", "inf"] {
            refused(&LIMIT.replace("'3'", &format!("'{strange}'")));
            refused(&LIMIT.replace("'2'", &format!("'{strange}'")));
        }
    }

    #[test]
    fn an_axis_without_direction_or_an_origin_that_is_not_finite_is_refused() {
        for rest in
            ["<axis xyz='0 0 0'/>", "<axis xyz='nan 0 0'/>", "<origin xyz='0 nan 0' rpy='0 0 0'/>"]
        {
            let xml = robot(&joint("revolute", "base", "tool", &[LIMIT, rest].concat()));
            assert!(chain(&xml, "base", "tool").is_err(), "{rest}");
        }
    }

    #[test]
    fn a_chain_in_which_nothing_moves_is_refused() {
        let xml = robot(&joint("fixed", "base", "tool", ""));
        assert!(refusal(&xml, "base", "tool").starts_with("no joint moves between"));
        assert!(refusal(&xml, "tool", "tool").starts_with("no joint moves between"));
    }

    #[test]
    fn a_continuous_joint_needs_only_a_velocity() {
        let limit = "<limit effort='1' velocity='3'/>";
        let xml = robot(&joint("continuous", "base", "tool", limit));
        let chain = chain(&xml, "base", "tool").unwrap();
        assert_eq!(chain.joints()[0].kind, JointKind::Continuous);
        assert!(chain.within_limits(&[100.0]) && chain.margin(&[100.0]) == f64::INFINITY);
    }

    #[test]
    fn accelerations_are_read_where_the_format_has_them() {
        let limit = LIMIT.replace("velocity", "acceleration='5' velocity");
        let xml = robot(&joint("revolute", "base", "tool", &limit));
        let acceleration = |xml: &str| chain(xml, "base", "tool").unwrap().joints()[0].acceleration;
        assert_eq!(acceleration(&xml), None);
        assert_eq!(acceleration(&xml.replace("<robot", "<robot version='1.2'")), Some(5.0));
    }

    /// Two moving links, a tool and a lamp on fixed joints, and a finger on a joint of its own.
    fn shaped() -> String {
        let shape = |name: &str, shapes: &str| format!("<link name='{name}'>{shapes}</link>");
        let collision = |origin: &str, geometry: &str| {
            format!("<collision>{origin}<geometry>{geometry}</geometry></collision>")
        };
        let links = [
            shape("floor", &collision("", "<box size='0.2 0.6 0.1'/>")),
            shape("base", ""),
            shape(
                "arm",
                &collision("<origin xyz='0 0 0.1'/>", "<cylinder radius='0.05' length='0.2'/>"),
            ),
            shape(
                "tool",
                &[
                    collision("<origin xyz='0 0 0.3'/>", "<sphere radius='0.02'/>"),
                    collision("", "<mesh filename='package://tool.stl'/>"),
                ]
                .concat(),
            ),
            shape("finger", &collision("", "<sphere radius='0.01'/>")),
        ];
        let offset = |xyz: &str| format!("<origin xyz='{xyz}' rpy='0 1.5707963267948966 0'/>");
        let joints = [
            joint("fixed", "floor", "base", "<origin xyz='0 0 1'/>"),
            joint("revolute", "base", "arm", LIMIT),
            joint("fixed", "arm", "tool", &offset("0 0 0.5")),
            joint("revolute", "tool", "finger", LIMIT),
        ];
        format!("<robot name='lathe'>{}{}</robot>", links.concat(), joints.concat())
    }

    #[test]
    fn shapes_become_capsules_in_the_frames_of_their_bodies() {
        let arm = arm(&shaped(), "base", "arm").unwrap();
        let near = |a: Point3<f64>, b: [f64; 3]| (a - Point3::from(b)).norm() < 1e-12;
        let [floor, cylinder, ball] = arm.parts.as_slice() else { panic!("{:?}", arm.parts) };
        // The floor is below the base, with its longest edge along y.
        assert_eq!((floor.link.as_str(), floor.body), ("floor", 0));
        assert!(near(floor.from, [0.0, -0.3, -1.0]) && near(floor.to, [0.0, 0.3, -1.0]));
        assert!((floor.radius - 0.1f64.hypot(0.05)).abs() < 1e-12);
        assert_eq!((cylinder.link.as_str(), cylinder.body, cylinder.radius), ("arm", 1, 0.05));
        assert!(near(cylinder.from, [0.0, 0.0, 0.0]) && near(cylinder.to, [0.0, 0.0, 0.2]));
        // The tool hangs on the arm, and its z is the arm's x.
        assert_eq!((ball.link.as_str(), ball.body), ("tool", 1));
        assert!(near(ball.from, [0.3, 0.0, 0.5]) && ball.from == ball.to);
        assert_eq!(arm.unmodelled, ["tool", "finger"]);
    }

    #[test]
    fn a_tool_of_the_robots_file_is_a_part_and_an_unknown_link_is_refused() {
        let arm = arm(&shaped(), "base", "arm").unwrap();
        let part = |link: &str| PartRule {
            link: link.into(),
            from_m: [0.0; 3],
            to_m: [0.0, 0.0, 0.1],
            radius_m: 0.01,
        };
        let rules = |link: &str| CollisionRules { parts: vec![part(link)], ..Default::default() };
        assert_eq!(arm.hull(&rules("tool")).unwrap().parts(), 4);
        let error = arm.hull(&rules("finger")).unwrap_err().to_string();
        assert!(error.contains("\"finger\"") && error.contains("base, arm"), "{error}");
        let ignore = vec![["arm".to_owned(), "moon".to_owned()]];
        assert!(arm.hull(&CollisionRules { ignore, ..Default::default() }).is_err());
        for clearance_m in [-0.1, f64::NAN, 2.0] {
            assert!(arm.hull(&CollisionRules { clearance_m, ..Default::default() }).is_err());
        }
    }
}
