//! Definitions of messages, which a recording carries so that others can decode it: the interfaces of ROS's own
//! packages that recordings of arms hold.

use std::collections::BTreeSet;

/// Line between two definitions, as `rosbag2` and MCAP's `ros2msg` have it: 80 equals signs.
const SEPARATOR: &str =
    "================================================================================";

/// The definition of a type, without those that it is made of; none where it is not known.
///
/// # Arguments
/// * `name`: such as `geometry_msgs/Point`
fn known(name: &str) -> Option<String> {
    let (package, message) = name.split_once('/')?;
    let fields = match (package, message) {
        ("builtin_interfaces", "Duration" | "Time") => "int32 sec\nuint32 nanosec\n",
        ("geometry_msgs", "Point" | "Vector3") => "float64 x\nfloat64 y\nfloat64 z\n",
        ("geometry_msgs", "PointStamped") => "std_msgs/Header header\nPoint point\n",
        ("geometry_msgs", "Pose") => "Point position\nQuaternion orientation\n",
        ("geometry_msgs", "PoseStamped") => "std_msgs/Header header\nPose pose\n",
        ("geometry_msgs", "Quaternion") => "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
        ("geometry_msgs", "Transform") => "Vector3 translation\nQuaternion rotation\n",
        ("geometry_msgs", "TransformStamped") => {
            "std_msgs/Header header\nstring child_frame_id\nTransform transform\n"
        }
        ("geometry_msgs", "Wrench") => "Vector3 force\nVector3 torque\n",
        ("geometry_msgs", "WrenchStamped") => "std_msgs/Header header\nWrench wrench\n",
        ("nav_msgs", "Path") => "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses\n",
        ("sensor_msgs", "JointState") => {
            "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n\
             float64[] effort\n"
        }
        // A message needs some text, else it would be taken for one without a definition.
        ("std_msgs", "Empty") => "# It has no fields.\n",
        ("std_msgs", "Header") => "builtin_interfaces/Time stamp\nstring frame_id\n",
        ("tf2_msgs", "TFMessage") => "geometry_msgs/TransformStamped[] transforms\n",
        ("std_msgs", number) => {
            let kind = match number {
                "Bool" | "Byte" | "Char" | "Float32" | "Float64" | "Int8" | "Int16" | "Int32"
                | "Int64" | "String" | "UInt8" | "UInt16" | "UInt32" | "UInt64" => {
                    number.to_ascii_lowercase()
                }
                _ => return None,
            };
            return Some(format!("{kind} data\n"));
        }
        _ => return None,
    };
    Some(fields.into())
}

/// The definition of a type with all that it is made of, in MCAP's `ros2msg` encoding; none where part of it is
/// not known.
///
/// # Arguments
/// * `type_name`: such as `geometry_msgs/msg/PoseStamped`
/// * `installed`: looks up the text of a type that is not known here, `my_msgs/Mark`
pub fn definition(type_name: &str, installed: impl Fn(&str) -> Option<String>) -> Option<String> {
    let (package, message) = type_name.split_once("/msg/")?;
    let mut wanted = vec![format!("{package}/{message}")];
    let mut seen: BTreeSet<String> = wanted.iter().cloned().collect();
    let mut text = String::new();
    while !wanted.is_empty() {
        let name = wanted.remove(0);
        let fields = known(&name).or_else(|| installed(&name))?;
        if !text.is_empty() {
            text += &format!("{SEPARATOR}\nMSG: {name}\n");
        }
        text += &fields;
        if !fields.ends_with('\n') {
            text.push('\n');
        }
        let package = name.split('/').next().unwrap_or_default();
        for part in fields.lines().filter_map(|line| part(line, package)) {
            if seen.insert(part.clone()) {
                wanted.push(part);
            }
        }
    }
    Some(text)
}

/// The type that a line of a definition uses, if it is no built-in one: `geometry_msgs/Point`.
fn part(line: &str, package: &str) -> Option<String> {
    let line = line.split('#').next().unwrap_or_default();
    let kind = line.split_whitespace().next()?.split('[').next()?.split("<=").next()?;
    match kind.split('/').collect::<Vec<_>>()[..] {
        // Built-in types begin with a small letter, messages with a capital one.
        [name] if name.starts_with(|c: char| c.is_ascii_uppercase()) => {
            Some(format!("{package}/{name}"))
        }
        [package, name] | [package, "msg", name] => Some(format!("{package}/{name}")),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_definition_holds_all_that_it_is_made_of_once() {
        let text = definition("geometry_msgs/msg/PoseStamped", |_| None).unwrap();
        let parts: Vec<_> = text.lines().filter_map(|line| line.strip_prefix("MSG: ")).collect();
        assert_eq!(
            parts,
            [
                "std_msgs/Header",
                "geometry_msgs/Pose",
                "builtin_interfaces/Time",
                "geometry_msgs/Point",
                "geometry_msgs/Quaternion"
            ]
        );
        assert!(text.starts_with(&format!("std_msgs/Header header\nPose pose\n{SEPARATOR}\n")));
        assert_eq!(SEPARATOR, "=".repeat(80));
        assert_eq!(definition("std_msgs/msg/UInt16", |_| None).as_deref(), Some("uint16 data\n"));
    }

    #[test]
    fn every_type_that_is_known_is_known_with_its_parts() {
        for name in [
            "sensor_msgs/msg/JointState",
            "std_msgs/msg/Bool",
            "std_msgs/msg/String",
            "std_msgs/msg/Empty",
            "std_msgs/msg/Float64",
            "geometry_msgs/msg/PointStamped",
            "geometry_msgs/msg/TransformStamped",
            "geometry_msgs/msg/WrenchStamped",
            "tf2_msgs/msg/TFMessage",
        ] {
            assert!(definition(name, |_| None).is_some_and(|text| !text.is_empty()), "{name}");
        }
    }

    #[test]
    fn what_is_not_known_is_looked_up_and_is_none_where_a_part_of_it_is_missing() {
        let mark = "# Mark/Not\nuint8 START=1\nInner[<=3] inner\nstring<=5 name\nother/msg/Deep deep # x\n";
        let installed = |name: &str| match name {
            "mine/Mark" => Some(mark.to_owned()),
            "mine/Inner" => Some("geometry_msgs/Point[2] ends".to_owned()),
            "other/Deep" => Some("float64[] data\n".to_owned()),
            _ => None,
        };
        let text = definition("mine/msg/Mark", installed).unwrap();
        let parts: Vec<_> = text.lines().filter_map(|line| line.strip_prefix("MSG: ")).collect();
        assert_eq!(parts, ["mine/Inner", "other/Deep", "geometry_msgs/Point"]);
        assert_eq!(definition("mine/msg/Other", installed), None);
        let without_deep = |name: &str| installed(name).filter(|_| name != "other/Deep");
        assert_eq!(definition("mine/msg/Mark", without_deep), None);
        assert_eq!(definition("std_msgs/Bool", |_| None), None);
        assert_eq!(definition("", |_| None), None);
    }
}
