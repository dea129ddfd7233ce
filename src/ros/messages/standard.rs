//! Messages of ROS's own packages, each module named as its package.

/// Time and duration.
pub mod builtin_interfaces {
    use serde::{Deserialize, Serialize};

    /// A point in time: seconds since the epoch, or since the simulation began.
    #[derive(
        Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize,
    )]
    pub struct Time {
        /// Whole seconds, rounded down.
        pub sec: i32,
        /// The rest, 0 to 999 999 999.
        pub nanosec: u32,
    }

    /// A span of time.
    #[derive(
        Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize,
    )]
    pub struct Duration {
        /// Whole seconds, rounded down.
        pub sec: i32,
        /// The rest, 0 to 999 999 999.
        pub nanosec: u32,
    }

    impl Duration {
        /// The nearest duration that the message can hold; NaN becomes zero.
        #[must_use]
        pub fn from_secs_f64(secs: f64) -> Self {
            let whole = secs.floor();
            let nanos = ((secs - whole) * 1e9).round();
            // Rounding may reach a full second.
            let (whole, nanos) = if nanos >= 1e9 { (whole + 1.0, 0.0) } else { (whole, nanos) };
            Self { sec: whole as i32, nanosec: nanos as u32 }
        }

        /// The same in seconds.
        #[must_use]
        pub fn as_secs_f64(self) -> f64 {
            f64::from(self.sec) + f64::from(self.nanosec) * 1e-9
        }
    }

    super::super::messages!(Time, Duration);
}

/// Header and string.
pub mod std_msgs {
    use super::builtin_interfaces::Time;
    use serde::{Deserialize, Serialize};

    /// When and in which frame.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct Header {
        /// When the data was true; zero where the sender does not say.
        pub stamp: Time,
        /// The frame that the data is given in.
        pub frame_id: String,
    }

    /// A text (`std_msgs/msg/String`).
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename = "String")]
    pub struct Text {
        /// The text.
        pub data: String,
    }

    /// A colour, each part from 0 to 1.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct ColorRGBA {
        /// Red.
        pub r: f32,
        /// Green.
        pub g: f32,
        /// Blue.
        pub b: f32,
        /// 0 can't be seen, 1 hides what is behind.
        pub a: f32,
    }

    super::super::messages!(Header, Text, ColorRGBA);
}

/// Points, poses, transforms, twists.
pub mod geometry_msgs {
    use super::std_msgs::Header;
    use serde::{Deserialize, Serialize};

    /// A point, m.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct Point {
        /// Along x.
        pub x: f64,
        /// Along y.
        pub y: f64,
        /// Along z.
        pub z: f64,
    }

    /// A direction, displacement or rate.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct Vector3 {
        /// Along x.
        pub x: f64,
        /// Along y.
        pub y: f64,
        /// Along z.
        pub z: f64,
    }

    /// A rotation as a quaternion. The default is ROS's: no rotation.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    pub struct Quaternion {
        /// First imaginary part.
        pub x: f64,
        /// Second imaginary part.
        pub y: f64,
        /// Third imaginary part.
        pub z: f64,
        /// Real part.
        pub w: f64,
    }

    impl Default for Quaternion {
        fn default() -> Self {
            Self { x: 0.0, y: 0.0, z: 0.0, w: 1.0 }
        }
    }

    /// Position and orientation.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct Pose {
        /// Where, m.
        pub position: Point,
        /// How turned.
        pub orientation: Quaternion,
    }

    /// A transform: rotate, then translate.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct Transform {
        /// Displacement, m.
        pub translation: Vector3,
        /// Rotation.
        pub rotation: Quaternion,
    }

    /// Velocity, or its derivative.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct Twist {
        /// m/s.
        pub linear: Vector3,
        /// rad/s.
        pub angular: Vector3,
    }

    /// A point in a named frame.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct PointStamped {
        /// When and in which frame.
        pub header: Header,
        /// The point, m.
        pub point: Point,
    }

    /// A pose in a named frame.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct PoseStamped {
        /// When and in which frame.
        pub header: Header,
        /// The pose.
        pub pose: Pose,
    }

    /// A transform between two named frames: `header.frame_id` from `child_frame_id`.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct TransformStamped {
        /// When, and the parent frame.
        pub header: Header,
        /// The child frame.
        pub child_frame_id: String,
        /// Takes the child's coordinates to the parent's.
        pub transform: Transform,
    }

    super::super::messages!(
        Point,
        Vector3,
        Quaternion,
        Pose,
        Transform,
        Twist,
        PointStamped,
        PoseStamped,
        TransformStamped,
    );
}

/// The transform tree.
pub mod tf2_msgs {
    use super::geometry_msgs::TransformStamped;
    use serde::{Deserialize, Serialize};

    /// Some edges of the transform tree, as on `/tf` and `/tf_static`.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct TFMessage {
        /// The edges.
        pub transforms: Vec<TransformStamped>,
    }

    super::super::messages!(TFMessage);
}

/// The state of joints.
pub mod sensor_msgs {
    use super::std_msgs::Header;
    use serde::{Deserialize, Serialize};

    /// Positions, velocities and efforts of named joints; an empty list means "not given".
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct JointState {
        /// When.
        pub header: Header,
        /// The joints.
        pub name: Vec<String>,
        /// rad, or m for a prismatic joint.
        pub position: Vec<f64>,
        /// rad/s or m/s.
        pub velocity: Vec<f64>,
        /// N m or N.
        pub effort: Vec<f64>,
    }

    /// A compressed image.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct CompressedImage {
        /// When and in which frame.
        pub header: Header,
        /// How it is compressed.
        pub format: String,
        /// The image.
        pub data: Vec<u8>,
    }

    super::super::messages!(JointState, CompressedImage);
}

/// Trajectories of joints and of frames.
pub mod trajectory_msgs {
    use super::builtin_interfaces::Duration;
    use super::geometry_msgs::{Transform, Twist};
    use super::std_msgs::Header;
    use serde::{Deserialize, Serialize};

    /// One point of a joint trajectory; each list is empty or has one value per joint.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct JointTrajectoryPoint {
        /// rad or m.
        pub positions: Vec<f64>,
        /// rad/s or m/s.
        pub velocities: Vec<f64>,
        /// rad/s^2 or m/s^2.
        pub accelerations: Vec<f64>,
        /// N m or N.
        pub effort: Vec<f64>,
        /// After the start of the trajectory.
        pub time_from_start: Duration,
    }

    /// A joint trajectory.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct JointTrajectory {
        /// When it starts; stamp 0 means at once.
        pub header: Header,
        /// The joints, in the order of the points' lists.
        pub joint_names: Vec<String>,
        /// The points, in the order of time.
        pub points: Vec<JointTrajectoryPoint>,
    }

    /// One point of a trajectory of frames; each list is empty or has one value per frame.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct MultiDOFJointTrajectoryPoint {
        /// Where the frames are.
        pub transforms: Vec<Transform>,
        /// How fast they move.
        pub velocities: Vec<Twist>,
        /// How their speed changes.
        pub accelerations: Vec<Twist>,
        /// After the start of the trajectory.
        pub time_from_start: Duration,
    }

    /// A trajectory of frames, such as the tip of an arm.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct MultiDOFJointTrajectory {
        /// When it starts, and the frame that the transforms are given in.
        pub header: Header,
        /// The frames that move, in the order of the points' lists.
        pub joint_names: Vec<String>,
        /// The points, in the order of time.
        pub points: Vec<MultiDOFJointTrajectoryPoint>,
    }

    super::super::messages!(
        JointTrajectoryPoint,
        JointTrajectory,
        MultiDOFJointTrajectoryPoint,
        MultiDOFJointTrajectory,
    );
}

/// Paths.
pub mod nav_msgs {
    use super::geometry_msgs::PoseStamped;
    use super::std_msgs::Header;
    use serde::{Deserialize, Serialize};

    /// A sequence of poses.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct Path {
        /// When and in which frame.
        pub header: Header,
        /// The poses.
        pub poses: Vec<PoseStamped>,
    }

    super::super::messages!(Path);
}

/// How a node is, for people who watch over robots.
pub mod diagnostic_msgs {
    use super::std_msgs::Header;
    use serde::{Deserialize, Serialize};

    /// A name and a value.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct KeyValue {
        /// What it is.
        pub key: String,
        /// What it is worth.
        pub value: String,
    }

    /// How one thing is.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct DiagnosticStatus {
        /// 0 well, 1 a warning, 2 an error, 3 stale.
        pub level: u8,
        /// What it is about.
        pub name: String,
        /// How it is.
        pub message: String,
        /// The hardware.
        pub hardware_id: String,
        /// Details.
        pub values: Vec<KeyValue>,
    }

    impl DiagnosticStatus {
        /// All is well.
        pub const OK: u8 = 0;
        /// Something to look at.
        pub const WARN: u8 = 1;
    }

    /// How several things are.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct DiagnosticArray {
        /// When.
        pub header: Header,
        /// The things.
        pub status: Vec<DiagnosticStatus>,
    }

    super::super::messages!(KeyValue, DiagnosticStatus, DiagnosticArray);
}

/// The states of a managed node.
pub mod lifecycle_msgs {
    use serde::{Deserialize, Serialize};

    /// A state.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct State {
        /// Its number.
        pub id: u8,
        /// Its name.
        pub label: String,
    }

    /// What leads from one state to another.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct Transition {
        /// Its number.
        pub id: u8,
        /// Its name; where a request has one, it counts.
        pub label: String,
    }

    /// A transition with its two ends.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct TransitionDescription {
        /// The transition.
        pub transition: Transition,
        /// Where it begins.
        pub start_state: State,
        /// Where it leads.
        pub goal_state: State,
    }

    /// A transition that has happened.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct TransitionEvent {
        /// When, ns.
        pub timestamp: u64,
        /// The transition.
        pub transition: Transition,
        /// Where it began.
        pub start_state: State,
        /// Where it led.
        pub goal_state: State,
    }

    /// A request without fields; ROS sends one byte in their place.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct EmptyRequest {
        /// Without meaning.
        pub structure_needs_at_least_one_member: u8,
    }

    /// The request of `lifecycle_msgs/srv/ChangeState`.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct ChangeStateRequest {
        /// What is asked for.
        pub transition: Transition,
    }

    /// The response of `lifecycle_msgs/srv/ChangeState`.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct ChangeStateResponse {
        /// Whether the node is in the new state.
        pub success: bool,
    }

    /// The response of `lifecycle_msgs/srv/GetState`.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct GetStateResponse {
        /// The state that the node is in.
        pub current_state: State,
    }

    /// The response of `lifecycle_msgs/srv/GetAvailableStates`.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct GetAvailableStatesResponse {
        /// All states.
        pub available_states: Vec<State>,
    }

    /// The response of `lifecycle_msgs/srv/GetAvailableTransitions`.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct GetAvailableTransitionsResponse {
        /// Those that lead away from the state that the node is in, or all.
        pub available_transitions: Vec<TransitionDescription>,
    }

    super::super::messages!(
        State,
        Transition,
        TransitionDescription,
        TransitionEvent,
        EmptyRequest,
        ChangeStateRequest,
        ChangeStateResponse,
        GetStateResponse,
        GetAvailableStatesResponse,
        GetAvailableTransitionsResponse,
    );
}

/// Shapes for people to look at.
pub mod visualization_msgs {
    use super::builtin_interfaces::Duration;
    use super::geometry_msgs::{Point, Pose, Vector3};
    use super::sensor_msgs::CompressedImage;
    use super::std_msgs::{ColorRGBA, Header};
    use serde::{Deserialize, Serialize};

    /// One shape. What a field means depends on the kind of shape.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct Marker {
        /// When and in which frame.
        pub header: Header,
        /// What the id is unique in.
        pub ns: String,
        /// A marker of the same namespace and id takes this one's place.
        pub id: i32,
        /// The kind of shape.
        pub r#type: i32,
        /// 0 shows it.
        pub action: i32,
        /// Where it is.
        pub pose: Pose,
        /// How large it is, m; of a line, x is the width.
        pub scale: Vector3,
        /// Its colour.
        pub color: ColorRGBA,
        /// How long it is shown; 0 for ever.
        pub lifetime: Duration,
        /// Whether it moves along with its frame.
        pub frame_locked: bool,
        /// Of a line its points, of triangles three corners each.
        pub points: Vec<Point>,
        /// A colour for each point, or none.
        pub colors: Vec<ColorRGBA>,
        /// Where a texture is found.
        pub texture_resource: String,
        /// A texture.
        pub texture: CompressedImage,
        /// Where each point is on the texture.
        pub uv_coordinates: Vec<UVCoordinate>,
        /// Of a text, what it says.
        pub text: String,
        /// Where a mesh is found.
        pub mesh_resource: String,
        /// A mesh.
        pub mesh_file: MeshFile,
        /// Whether a mesh brings its colours along.
        pub mesh_use_embedded_materials: bool,
    }

    impl Marker {
        /// A ball.
        pub const SPHERE: i32 = 2;
        /// A cylinder along z.
        pub const CYLINDER: i32 = 3;
        /// A line through all points.
        pub const LINE_STRIP: i32 = 4;
        /// A triangle for each three points.
        pub const TRIANGLE_LIST: i32 = 11;
        /// The action that removes all markers.
        pub const DELETE_ALL: i32 = 3;
    }

    /// A place on a texture, each part from 0 to 1.
    #[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct UVCoordinate {
        /// From left to right.
        pub u: f32,
        /// From top to bottom.
        pub v: f32,
    }

    /// A mesh.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct MeshFile {
        /// Its name, of which the ending says what it is.
        pub filename: String,
        /// Its content.
        pub data: Vec<u8>,
    }

    /// Shapes that are shown together.
    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    pub struct MarkerArray {
        /// The shapes.
        pub markers: Vec<Marker>,
    }

    super::super::messages!(Marker, UVCoordinate, MeshFile, MarkerArray);
}

/// The trigger service.
pub mod std_srvs {
    use serde::{Deserialize, Serialize};

    /// The request of `std_srvs/srv/Trigger`, which has no fields; ROS sends one byte in their
    /// place.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename = "Trigger_Request")]
    pub struct TriggerRequest {
        /// Without meaning.
        pub structure_needs_at_least_one_member: u8,
    }

    /// The response of `std_srvs/srv/Trigger`.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename = "Trigger_Response")]
    pub struct TriggerResponse {
        /// Whether it worked.
        pub success: bool,
        /// What came of it, or why it did not work.
        pub message: String,
    }

    super::super::messages!(TriggerRequest, TriggerResponse);
}

/// The levels of loggers; what else the package has, ros2-client has.
pub mod rcl_interfaces {
    use serde::{Deserialize, Serialize};

    /// Which messages a logger lets through.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct LoggerLevel {
        /// The logger.
        pub name: String,
        /// A constant of `Log.msg`, or 0 for that of the logger above it.
        pub level: u32,
    }

    /// Whether a level was set.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct SetLoggerLevelsResult {
        /// Whether it was.
        pub successful: bool,
        /// Why not.
        pub reason: String,
    }

    /// The request of `srv/GetLoggerLevels`.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename = "GetLoggerLevels_Request")]
    pub struct GetLoggerLevelsRequest {
        /// Which loggers.
        pub names: Vec<String>,
    }

    /// The response of `srv/GetLoggerLevels`.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename = "GetLoggerLevels_Response")]
    pub struct GetLoggerLevelsResponse {
        /// One for each name.
        pub levels: Vec<LoggerLevel>,
    }

    /// The request of `srv/SetLoggerLevels`.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename = "SetLoggerLevels_Request")]
    pub struct SetLoggerLevelsRequest {
        /// Which loggers, and their levels.
        pub levels: Vec<LoggerLevel>,
    }

    /// The response of `srv/SetLoggerLevels`.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename = "SetLoggerLevels_Response")]
    pub struct SetLoggerLevelsResponse {
        /// One for each level.
        pub results: Vec<SetLoggerLevelsResult>,
    }

    super::super::messages!(
        GetLoggerLevelsRequest,
        GetLoggerLevelsResponse,
        SetLoggerLevelsRequest,
        SetLoggerLevelsResponse,
    );
}

/// What types are made of.
pub mod type_description_interfaces {
    use serde::{Deserialize, Serialize};

    /// The type of a field.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct FieldType {
        /// A constant of `FieldType.msg`.
        pub type_id: u8,
        /// Elements of an array, or the most of a bounded sequence; 0 elsewhere.
        pub capacity: u64,
        /// The longest of a bounded string; 0 elsewhere.
        pub string_capacity: u64,
        /// The type that the field is of; empty for those built in.
        pub nested_type_name: String,
    }

    /// A field.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct Field {
        /// Its name.
        pub name: String,
        /// Its type.
        pub r#type: FieldType,
        /// As in the definition; empty where it has none.
        pub default_value: String,
    }

    /// A type without those that it refers to.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct IndividualTypeDescription {
        /// Its name, `package/msg/Name`.
        pub type_name: String,
        /// Its fields.
        pub fields: Vec<Field>,
    }

    /// A type, and all that it refers to in the order of their names.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct TypeDescription {
        /// The type itself.
        pub type_description: IndividualTypeDescription,
        /// Those that it refers to, directly and through others.
        pub referenced_type_descriptions: Vec<IndividualTypeDescription>,
    }

    /// The text that a type comes from.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct TypeSource {
        /// Its name.
        pub type_name: String,
        /// `msg`, `srv` or `action`.
        pub encoding: String,
        /// The text.
        pub raw_file_contents: String,
    }

    /// A key and what it stands for.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    pub struct KeyValue {
        /// The key.
        pub key: String,
        /// What it stands for.
        pub value: String,
    }

    /// The request of `srv/GetTypeDescription`.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename = "GetTypeDescription_Request")]
    pub struct GetTypeDescriptionRequest {
        /// `package/msg/Name`.
        pub type_name: String,
        /// `RIHS01_…`.
        pub type_hash: String,
        /// Whether the texts are wanted, too.
        pub include_type_sources: bool,
    }

    /// The response of `srv/GetTypeDescription`.
    #[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename = "GetTypeDescription_Response")]
    pub struct GetTypeDescriptionResponse {
        /// Whether the rest says anything.
        pub successful: bool,
        /// Why not.
        pub failure_reason: String,
        /// What the type is made of.
        pub type_description: TypeDescription,
        /// The texts.
        pub type_sources: Vec<TypeSource>,
        /// Nothing so far.
        pub extra_information: Vec<KeyValue>,
    }

    super::super::messages!(GetTypeDescriptionRequest, GetTypeDescriptionResponse);
}
