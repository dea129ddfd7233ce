//! The structs against rclpy's serialisation and against the interface definitions.

use super::*;
use ros2_client::{log::Log, parameters::raw, rcl_interfaces};
use rustdds::RepresentationIdentifier;
use rustdds::serialization::{deserialize_from_cdr_with_rep_id, to_writer_with_rep_id};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use serde_reflection::{ContainerFormat, Format, Tracer, TracerConfig};
use std::collections::BTreeSet;
use std::fmt::Debug;

/// One line of `tests/golden/messages.json`.
#[derive(Deserialize)]
struct Golden {
    r#type: String,
    fields: Vec<(String, String)>,
    value: serde_json::Value,
    cdr: String,
}

fn golden() -> Vec<Golden> {
    serde_json::from_str(include_str!("../../../tests/golden/messages.json")).unwrap()
}

fn encode<T: Serialize>(message: &T) -> Vec<u8> {
    // The encapsulation header: little-endian CDR, no options.
    let mut bytes = vec![0, 1, 0, 0];
    to_writer_with_rep_id(&mut bytes, message, RepresentationIdentifier::CDR_LE).unwrap();
    bytes
}

fn decode<T: DeserializeOwned>(bytes: &[u8]) -> T {
    assert_eq!(bytes[..4], [0, 1, 0, 0], "rclpy writes little-endian CDR");
    let (message, used) =
        deserialize_from_cdr_with_rep_id(&bytes[4..], RepresentationIdentifier::CDR_LE).unwrap();
    assert_eq!(used, bytes.len() - 4, "bytes read");
    message
}

/// The names of a struct's fields and their types as IDL names them, without packages.
fn fields_of<T: DeserializeOwned>() -> Vec<(String, String)> {
    let mut tracer = Tracer::new(TracerConfig::default().is_human_readable(false));
    let (format, _) = tracer.trace_simple_type::<T>().unwrap();
    let Format::TypeName(name) = format else { panic!("{format:?} is no struct") };
    match tracer.registry().unwrap().remove(&name) {
        Some(ContainerFormat::Struct(fields)) => {
            fields.into_iter().map(|field| (field.name, idl(&field.value))).collect()
        }
        other => panic!("{name} has no named fields: {other:?}"),
    }
}

fn idl(format: &Format) -> String {
    match format {
        Format::Bool => "boolean".into(),
        Format::U8 => "uint8".into(),
        Format::I32 => "int32".into(),
        Format::U32 => "uint32".into(),
        Format::U64 => "uint64".into(),
        Format::F32 => "float".into(),
        Format::F64 => "double".into(),
        Format::Str => "string".into(),
        Format::Seq(item) => format!("sequence<{}>", idl(item)),
        Format::TypeName(name) => name.clone(),
        other => panic!("no message uses {other:?}"),
    }
}

/// `sequence<geometry_msgs/Point>` without the package.
fn without_package(idl: &str) -> String {
    match (idl.split_once('<'), idl.rsplit_once('/')) {
        (Some((outer, _)), Some((_, last))) => format!("{outer}<{last}"),
        (None, Some((_, last))) => last.into(),
        // ROS's `byte`.
        (_, None) if idl == "octet" => "uint8".into(),
        (_, None) => idl.into(),
    }
}

fn without_packages(fields: &[(String, String)]) -> Vec<(String, String)> {
    fields.iter().map(|(name, kind)| (name.clone(), without_package(kind))).collect()
}

fn hex(text: &str) -> Vec<u8> {
    (0..text.len()).step_by(2).map(|i| u8::from_str_radix(&text[i..i + 2], 16).unwrap()).collect()
}

/// A struct of ours: values, bytes and fields.
fn check_ours<T: Serialize + DeserializeOwned + PartialEq + Debug>(golden: &Golden) {
    let bytes = hex(&golden.cdr);
    let expected: T = serde_json::from_value(golden.value.clone()).unwrap();
    assert_eq!(decode::<T>(&bytes), expected, "decoding {}", golden.r#type);
    assert_eq!(encode(&expected), bytes, "encoding {}", golden.r#type);
    assert_eq!(fields_of::<T>(), without_packages(&golden.fields), "fields of {}", golden.r#type);
}

/// A struct of ros2-client's: bytes in, bytes out.
fn check_theirs<T: Serialize + DeserializeOwned>(golden: &Golden) {
    let bytes = hex(&golden.cdr);
    assert_eq!(encode(&decode::<T>(&bytes)), bytes, "{}", golden.r#type);
}

fn check(golden: &Golden) {
    let check = match golden.r#type.as_str() {
        "builtin_interfaces/msg/Time" => check_ours::<builtin_interfaces::Time>,
        "builtin_interfaces/msg/Duration" => check_ours::<builtin_interfaces::Duration>,
        "std_msgs/msg/Header" => check_ours::<std_msgs::Header>,
        "std_msgs/msg/String" => check_ours::<std_msgs::Text>,
        "geometry_msgs/msg/Point" => check_ours::<geometry_msgs::Point>,
        "geometry_msgs/msg/Vector3" => check_ours::<geometry_msgs::Vector3>,
        "geometry_msgs/msg/Quaternion" => check_ours::<geometry_msgs::Quaternion>,
        "geometry_msgs/msg/Pose" => check_ours::<geometry_msgs::Pose>,
        "geometry_msgs/msg/Transform" => check_ours::<geometry_msgs::Transform>,
        "geometry_msgs/msg/Twist" => check_ours::<geometry_msgs::Twist>,
        "geometry_msgs/msg/PointStamped" => check_ours::<geometry_msgs::PointStamped>,
        "geometry_msgs/msg/PoseStamped" => check_ours::<geometry_msgs::PoseStamped>,
        "geometry_msgs/msg/TransformStamped" => check_ours::<geometry_msgs::TransformStamped>,
        "tf2_msgs/msg/TFMessage" => check_ours::<tf2_msgs::TFMessage>,
        "sensor_msgs/msg/JointState" => check_ours::<sensor_msgs::JointState>,
        "trajectory_msgs/msg/JointTrajectoryPoint" => {
            check_ours::<trajectory_msgs::JointTrajectoryPoint>
        }
        "trajectory_msgs/msg/JointTrajectory" => check_ours::<trajectory_msgs::JointTrajectory>,
        "trajectory_msgs/msg/MultiDOFJointTrajectoryPoint" => {
            check_ours::<trajectory_msgs::MultiDOFJointTrajectoryPoint>
        }
        "trajectory_msgs/msg/MultiDOFJointTrajectory" => {
            check_ours::<trajectory_msgs::MultiDOFJointTrajectory>
        }
        "std_msgs/msg/ColorRGBA" => check_ours::<std_msgs::ColorRGBA>,
        "sensor_msgs/msg/CompressedImage" => check_ours::<sensor_msgs::CompressedImage>,
        "visualization_msgs/msg/UVCoordinate" => check_ours::<visualization_msgs::UVCoordinate>,
        "visualization_msgs/msg/MeshFile" => check_ours::<visualization_msgs::MeshFile>,
        "visualization_msgs/msg/Marker" => check_ours::<visualization_msgs::Marker>,
        "visualization_msgs/msg/MarkerArray" => check_ours::<visualization_msgs::MarkerArray>,
        "diagnostic_msgs/msg/KeyValue" => check_ours::<diagnostic_msgs::KeyValue>,
        "diagnostic_msgs/msg/DiagnosticStatus" => check_ours::<diagnostic_msgs::DiagnosticStatus>,
        "diagnostic_msgs/msg/DiagnosticArray" => check_ours::<diagnostic_msgs::DiagnosticArray>,
        "lifecycle_msgs/msg/TransitionEvent" => check_ours::<lifecycle_msgs::TransitionEvent>,
        "lifecycle_msgs/srv/GetState_Request" => check_ours::<lifecycle_msgs::EmptyRequest>,
        "lifecycle_msgs/srv/ChangeState_Request" => {
            check_ours::<lifecycle_msgs::ChangeStateRequest>
        }
        "lifecycle_msgs/srv/ChangeState_Response" => {
            check_ours::<lifecycle_msgs::ChangeStateResponse>
        }
        "lifecycle_msgs/srv/GetState_Response" => check_ours::<lifecycle_msgs::GetStateResponse>,
        "lifecycle_msgs/srv/GetAvailableStates_Response" => {
            check_ours::<lifecycle_msgs::GetAvailableStatesResponse>
        }
        "lifecycle_msgs/srv/GetAvailableTransitions_Response" => {
            check_ours::<lifecycle_msgs::GetAvailableTransitionsResponse>
        }
        "nav_msgs/msg/Path" => check_ours::<nav_msgs::Path>,
        "std_srvs/srv/Trigger_Request" => check_ours::<std_srvs::TriggerRequest>,
        "std_srvs/srv/Trigger_Response" => check_ours::<std_srvs::TriggerResponse>,
        "tcvae_msgs/msg/TaskLocation" => check_ours::<tcvae_msgs::TaskLocation>,
        "tcvae_msgs/msg/MannerParameter" => check_ours::<tcvae_msgs::MannerParameter>,
        "tcvae_msgs/msg/Sample" => check_ours::<tcvae_msgs::Sample>,
        "tcvae_msgs/srv/SampleTrajectory_Request" => {
            check_ours::<tcvae_msgs::SampleTrajectoryRequest>
        }
        "tcvae_msgs/srv/SampleTrajectory_Response" => {
            check_ours::<tcvae_msgs::SampleTrajectoryResponse>
        }
        "tcvae_msgs/srv/SetManner_Request" => check_ours::<tcvae_msgs::SetMannerRequest>,
        "tcvae_msgs/srv/SetManner_Response" => check_ours::<tcvae_msgs::SetMannerResponse>,
        "tcvae_msgs/srv/DescribePrimitive_Request" => {
            check_ours::<tcvae_msgs::DescribePrimitiveRequest>
        }
        "tcvae_msgs/srv/DescribePrimitive_Response" => {
            check_ours::<tcvae_msgs::DescribePrimitiveResponse>
        }
        "tcvae_msgs/srv/LoadModel_Request" => check_ours::<tcvae_msgs::LoadModelRequest>,
        "tcvae_msgs/srv/LoadModel_Response" => check_ours::<tcvae_msgs::LoadModelResponse>,
        "tcvae_msgs/action/Execute_Goal" => check_ours::<tcvae_msgs::ExecuteGoal>,
        "tcvae_msgs/action/Execute_Result" => check_ours::<tcvae_msgs::ExecuteResult>,
        "tcvae_msgs/action/Execute_Feedback" => check_ours::<tcvae_msgs::ExecuteFeedback>,
        "rcl_interfaces/msg/Log" => check_theirs::<Log>,
        "rcl_interfaces/msg/ParameterEvent" => check_theirs::<raw::ParameterEvent>,
        "rcl_interfaces/srv/ListParameters_Request" => {
            check_theirs::<rcl_interfaces::ListParametersRequest>
        }
        "rcl_interfaces/srv/ListParameters_Response" => {
            check_theirs::<rcl_interfaces::ListParametersResponse>
        }
        "rcl_interfaces/srv/GetParameters_Request" => {
            check_theirs::<rcl_interfaces::GetParametersRequest>
        }
        "rcl_interfaces/srv/GetParameters_Response" => {
            check_theirs::<rcl_interfaces::GetParametersResponse>
        }
        "rcl_interfaces/srv/GetParameterTypes_Request" => {
            check_theirs::<rcl_interfaces::GetParameterTypesRequest>
        }
        "rcl_interfaces/srv/GetParameterTypes_Response" => {
            check_theirs::<rcl_interfaces::GetParameterTypesResponse>
        }
        "rcl_interfaces/srv/SetParameters_Request" => {
            check_theirs::<rcl_interfaces::SetParametersRequest>
        }
        "rcl_interfaces/srv/SetParameters_Response" => {
            check_theirs::<rcl_interfaces::SetParametersResponse>
        }
        // ros2-client has no type of this name; the fields are those of SetParameters.
        "rcl_interfaces/srv/SetParametersAtomically_Request" => {
            check_theirs::<rcl_interfaces::SetParametersRequest>
        }
        "rcl_interfaces/srv/SetParametersAtomically_Response" => {
            check_theirs::<rcl_interfaces::SetParametersAtomicallyResponse>
        }
        "rcl_interfaces/srv/DescribeParameters_Request" => {
            check_theirs::<rcl_interfaces::DescribeParametersRequest>
        }
        "rcl_interfaces/srv/DescribeParameters_Response" => {
            check_theirs::<rcl_interfaces::DescribeParametersResponse>
        }
        other => panic!("tests/golden/messages.json has {other}, for which there is no struct"),
    };
    check(golden);
}

#[test]
fn messages_are_byte_for_byte_what_rclpy_writes() {
    let golden = golden();
    golden.iter().for_each(check);
    let types: BTreeSet<&str> = golden.iter().map(|line| line.r#type.as_str()).collect();
    assert!(types.len() >= 50, "only {} types: was the golden file cut?", types.len());
}

/// The sections of a definition, each a list of (field, IDL type).
fn definition(text: &str) -> Vec<Vec<(String, String)>> {
    let mut sections = vec![vec![]];
    for line in text.lines() {
        let line = line.split('#').next().unwrap().trim();
        if line == "---" {
            sections.push(vec![]);
        } else if !line.is_empty() && !line.contains('=') {
            let (kind, name) = line.split_once(char::is_whitespace).unwrap();
            let (item, list) = match kind.strip_suffix("[]") {
                Some(item) => (item, true),
                None => (kind, false),
            };
            let item = match item {
                "float64" => "double",
                "bool" => "boolean",
                other => other,
            };
            let kind = if list { format!("sequence<{item}>") } else { item.into() };
            sections.last_mut().unwrap().push((name.trim().into(), without_package(&kind)));
        }
    }
    for section in &mut sections {
        if section.is_empty() {
            section.push(("structure_needs_at_least_one_member".into(), "uint8".into()));
        }
    }
    sections
}

#[test]
fn fields_are_those_of_the_interface_package() {
    use tcvae_msgs::*;
    macro_rules! interface {
        ($file:literal, $($part:ty),+) => {
            assert_eq!(
                vec![$(fields_of::<$part>()),+],
                definition(include_str!(concat!("../../../msg/tcvae_msgs/", $file))),
                $file
            );
        };
    }
    interface!("msg/TaskLocation.msg", TaskLocation);
    interface!("msg/MannerParameter.msg", MannerParameter);
    interface!("msg/Sample.msg", Sample);
    interface!("srv/SampleTrajectory.srv", SampleTrajectoryRequest, SampleTrajectoryResponse);
    interface!("srv/SetManner.srv", SetMannerRequest, SetMannerResponse);
    interface!("srv/DescribePrimitive.srv", DescribePrimitiveRequest, DescribePrimitiveResponse);
    interface!("srv/LoadModel.srv", LoadModelRequest, LoadModelResponse);
    interface!("action/Execute.action", ExecuteGoal, ExecuteResult, ExecuteFeedback);
}

#[test]
fn the_error_codes_of_the_interface_package_are_those_of_the_server() {
    let file = include_str!("../../../msg/tcvae_msgs/msg/ErrorCode.msg");
    let constants: Vec<(&str, i32)> = file
        .lines()
        .filter_map(|line| line.strip_prefix("int32 ")?.split_once('='))
        .map(|(name, value)| (name, value.parse().unwrap()))
        .collect();
    let codes: Vec<(&str, i32)> =
        crate::serving::ErrorCode::ALL.iter().map(|code| (code.name(), *code as i32)).collect();
    assert_eq!(constants, codes);
}

#[test]
fn a_duration_keeps_its_nanoseconds_below_a_second() {
    use builtin_interfaces::Duration;
    let cases =
        [(0.0, 0, 0), (1.25, 1, 250_000_000), (-0.25, -1, 750_000_000), (2.999_999_999_9, 3, 0)];
    for (secs, sec, nanosec) in cases {
        assert_eq!(Duration::from_secs_f64(secs), Duration { sec, nanosec }, "{secs}");
    }
    assert_eq!(Duration { sec: 3, nanosec: 500_000_000 }.as_secs_f64(), 3.5);
}
