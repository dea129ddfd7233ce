//! Why a request is not served: the codes of `tcvae_msgs/msg/ErrorCode`, always with a message.

/// The constants of `tcvae_msgs/msg/ErrorCode`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(i32)]
pub enum ErrorCode {
    /// Served.
    Ok = 0,
    /// A location of the task was never given.
    NoTask = 1,
    /// The task is older than `task.max_age_s`.
    StaleTask = 2,
    /// A location that the model does not have.
    TaskUnknown = 3,
    /// NaN or infinity in a request.
    NotFinite = 10,
    /// A frame that is empty or not known.
    FrameUnknown = 11,
    /// A known frame, but no transform at that time.
    TransformFailed = 12,
    /// The task lies outside what the model was trained on.
    OutOfDistribution = 20,
    /// A manner parameter that the model does not have.
    MannerUnknown = 21,
    /// A manner parameter outside its bounds.
    MannerRange = 22,
    /// A pose that no joint configuration reaches.
    Unreachable = 30,
    /// A joint would leave its limits.
    JointLimit = 31,
    /// A joint would step further than its velocity allows.
    JointJump = 32,
    /// The arm stands too far from the first point.
    StartTooFar = 33,
    /// Too fast even when slowed down as far as allowed.
    TooFast = 34,
    /// The arm would hit the table or itself.
    Collision = 35,
    /// No fresh joint states.
    StaleJointState = 36,
    /// The motion misses its task by more than the tolerance.
    TaskCheckFailed = 40,
    /// The motion breaks a bound of validity.
    InvalidMotion = 41,
    /// The model was made for another robot.
    RobotMismatch = 50,
    /// A file that can't be read as what it should be.
    BadFile = 51,
    /// A file of a newer format.
    FormatVersion = 52,
    /// A request that makes no sense: wrong lengths, too many samples.
    BadRequest = 60,
    /// The node is not active.
    NotActive = 61,
    /// Too many requests at once.
    Busy = 70,
    /// The controller rejected the goal.
    ControllerRejected = 80,
    /// The controller gave up.
    ControllerAborted = 81,
    /// A broken contract of the program itself.
    Internal = 99,
}

impl ErrorCode {
    /// Every code, in the order of their values.
    pub const ALL: [Self; 28] = [
        Self::Ok,
        Self::NoTask,
        Self::StaleTask,
        Self::TaskUnknown,
        Self::NotFinite,
        Self::FrameUnknown,
        Self::TransformFailed,
        Self::OutOfDistribution,
        Self::MannerUnknown,
        Self::MannerRange,
        Self::Unreachable,
        Self::JointLimit,
        Self::JointJump,
        Self::StartTooFar,
        Self::TooFast,
        Self::Collision,
        Self::StaleJointState,
        Self::TaskCheckFailed,
        Self::InvalidMotion,
        Self::RobotMismatch,
        Self::BadFile,
        Self::FormatVersion,
        Self::BadRequest,
        Self::NotActive,
        Self::Busy,
        Self::ControllerRejected,
        Self::ControllerAborted,
        Self::Internal,
    ];

    /// The name of the constant in `ErrorCode.msg`: `OUT_OF_DISTRIBUTION`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ok => "OK",
            Self::NoTask => "NO_TASK",
            Self::StaleTask => "STALE_TASK",
            Self::TaskUnknown => "TASK_UNKNOWN",
            Self::NotFinite => "NOT_FINITE",
            Self::FrameUnknown => "FRAME_UNKNOWN",
            Self::TransformFailed => "TRANSFORM_FAILED",
            Self::OutOfDistribution => "OUT_OF_DISTRIBUTION",
            Self::MannerUnknown => "MANNER_UNKNOWN",
            Self::MannerRange => "MANNER_RANGE",
            Self::Unreachable => "UNREACHABLE",
            Self::JointLimit => "JOINT_LIMIT",
            Self::JointJump => "JOINT_JUMP",
            Self::StartTooFar => "START_TOO_FAR",
            Self::TooFast => "TOO_FAST",
            Self::Collision => "COLLISION",
            Self::StaleJointState => "STALE_JOINT_STATE",
            Self::TaskCheckFailed => "TASK_CHECK_FAILED",
            Self::InvalidMotion => "INVALID_MOTION",
            Self::RobotMismatch => "ROBOT_MISMATCH",
            Self::BadFile => "BAD_FILE",
            Self::FormatVersion => "FORMAT_VERSION",
            Self::BadRequest => "BAD_REQUEST",
            Self::NotActive => "NOT_ACTIVE",
            Self::Busy => "BUSY",
            Self::ControllerRejected => "CONTROLLER_REJECTED",
            Self::ControllerAborted => "CONTROLLER_ABORTED",
            Self::Internal => "INTERNAL",
        }
    }
}

/// A request that is not served: a code, and a message of fact, number, limit and next step.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{} ({}): {message}", .code.name(), *.code as i32)]
pub struct Refusal {
    /// The code.
    pub code: ErrorCode,
    /// The message.
    pub message: String,
}

impl Refusal {
    /// A refusal with this code and message.
    pub fn new(code: ErrorCode, message: impl Into<String>) -> Self {
        Self { code, message: message.into() }
    }
}
