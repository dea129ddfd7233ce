//! What the node's parameters are, and what setting one does: a view of the
//! [`PrimitiveServer`] and of a few settings of the node itself.

use std::collections::BTreeMap;
use std::sync::Arc;

use ros2_client::ParameterValue;

use super::lifecycle::Lifecycle;
use super::names::NodeNames;
use super::parameters::{Parameter, Range, find, suggestion};
use crate::serving::{
    ErrorCode, MannerMode, OutOfDistribution, PrimitiveServer, Refusal, Robot, SPEEDS, ServedModel,
    Settings, StartPolicy,
};

/// Reads models and robots from files; an empty path means the built-in one. The binary provides
/// it, since files are its business.
pub trait Loader: Send + Sync {
    /// The model at this path.
    ///
    /// # Errors
    /// [`ErrorCode::BadFile`], [`ErrorCode::FormatVersion`].
    fn model(&self, path: &str) -> Result<ServedModel, Refusal>;

    /// The robot of these files.
    ///
    /// # Errors
    /// [`ErrorCode::BadFile`], [`ErrorCode::RobotMismatch`].
    fn robot(&self, files: &RobotFiles) -> Result<Robot, Refusal>;
}

/// Where the robot comes from. At least one of the first two is empty.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RobotFiles {
    /// A robot's TOML; it says everything, so that the rest does not count.
    pub robot_path: String,
    /// A robot's description; empty for the built-in one.
    pub urdf_path: String,
    /// Link that all positions are given in.
    pub base_frame: String,
    /// Link that moves.
    pub tip_link: String,
}

impl RobotFiles {
    /// The file that the robot comes from; empty for the built-in one.
    pub fn path(&self) -> &str {
        if self.robot_path.is_empty() { &self.urdf_path } else { &self.robot_path }
    }
}

/// The state of the node. A clone is cheap, so a change is made on a clone that takes the place
/// of the original when all of it went well.
#[derive(Debug, Clone)]
pub struct NodeState {
    /// The server of motions.
    pub server: PrimitiveServer,
    /// Whether a task topic asks for a trajectory as the goal pose does.
    pub publish_on_task: bool,
    /// Whether time comes from `/clock`.
    pub use_sim_time: bool,
    /// Whether it serves.
    pub lifecycle: Lifecycle,
    /// How often it was activated.
    activations: u64,
    /// Whether it served from the start, without being told to.
    autostart: bool,
    /// How long a transform is waited for (s).
    pub tf_timeout_secs: f64,
    /// How late a message may come that asks for a motion (s); 0 for any time.
    pub max_delay_secs: f64,
    /// The action of the controller that `~/execute` has drive; empty for none.
    pub controller: String,
    /// How long the controller may take to appear, to accept and to stop (s).
    pub controller_timeout_secs: f64,
    /// How much longer than planned the controller may drive (s).
    pub controller_grace_secs: f64,
    model_path: String,
    robot: RobotFiles,
    /// What each location of the task is while nothing else was given.
    defaults: Vec<(String, Option<[f64; 2]>)>,
}

/// A model read from a file, ready to be served.
#[derive(Debug, Clone)]
pub struct Loaded {
    /// The path that it was read from.
    pub path: String,
    /// The model.
    pub model: Arc<ServedModel>,
}

/// The parameters that are fixed at start, and what they are for. All may be empty at start.
const FIXED: [(&str, &str); 4] = [
    (
        "robot_path",
        "Robot's TOML, as tcvae's --robot: description, frames, limits, what must not be touched; \
         empty for urdf_path, base_frame and tip_link",
    ),
    ("urdf_path", "Robot description (URDF file); empty for the built-in Baxter"),
    ("base_frame", "Link that all positions are given in; empty at start for the model's"),
    ("tip_link", "Link that the motion moves; empty at start for the model's"),
];

/// The parameter that says whether the node serves from the start.
const AUTOSTART: &str = "autostart";

/// The largest seed of a parameter: graphical tools, rqt's sliders among them, hold whole numbers in 32 bits, and show
/// nothing at all of a node that has a larger range.
const MOST_SEED: i64 = i32::MAX as i64;

/// The height of a table that nothing can touch.
const NO_TABLE_M: f64 = -10.0;

impl NodeState {
    /// The state at start, with these parameters; and warnings of those that there are not.
    ///
    /// # Errors
    /// A file that can't be read or does not fit, a value that is not accepted.
    pub fn new(
        mut values: BTreeMap<String, ParameterValue>,
        loader: &dyn Loader,
    ) -> Result<(Self, Vec<String>), Refusal> {
        let autostart = match values.remove(AUTOSTART) {
            None => true,
            Some(ParameterValue::Boolean(autostart)) => autostart,
            Some(_) => {
                return Err(bad_request("autostart is not a bool; write autostart:=false".into()));
            }
        };
        let mut text = |name: &str| match values.remove(name) {
            None => Ok(String::new()),
            Some(ParameterValue::String(text)) => Ok(text),
            Some(_) => Err(bad_request(format!("{name} is not a string; write {name}:='…'"))),
        };
        let model_path = text("model_path")?;
        let [robot_path, urdf_path, base_frame, tip_link] = FIXED.map(|(name, _)| text(name));
        let mut files = RobotFiles {
            robot_path: robot_path?,
            urdf_path: urdf_path?,
            base_frame: base_frame?,
            tip_link: tip_link?,
        };
        let model = loader.model(&model_path)?;
        if files.robot_path.is_empty() {
            let RobotFiles { base_frame, tip_link, .. } = &mut files;
            let models = [&model.robot.base_frame, &model.robot.tip_frame];
            for (frame, models) in [base_frame, tip_link].into_iter().zip(models) {
                if frame.is_empty() {
                    frame.clone_from(models);
                }
            }
        } else if !files.urdf_path.is_empty() {
            return Err(bad_request(
                "robot_path says what urdf_path would; leave one of them empty".into(),
            ));
        }
        let robot = loader.robot(&files)?;
        // A file of parameters that was dumped from a node has the frames of the robot.
        let frames = [
            ("base_frame", &files.base_frame, robot.chain.base_frame()),
            ("tip_link", &files.tip_link, robot.chain.tip_frame()),
        ];
        for (name, asked, robots) in frames {
            if !asked.is_empty() && asked != robots {
                return Err(bad_request(format!(
                    "{name} is {asked:?}, and the robot's is {robots:?}; robot_path says it, so leave {name} empty"
                )));
            }
        }
        files.base_frame = robot.chain.base_frame().to_owned();
        files.tip_link = robot.chain.tip_frame().to_owned();
        let server = PrimitiveServer::new(Arc::new(model), Arc::new(robot), Settings::default())?;
        let mut state = Self {
            defaults: no_defaults(&server),
            server,
            publish_on_task: false,
            use_sim_time: false,
            lifecycle: if autostart { Lifecycle::Active } else { Lifecycle::Unconfigured },
            activations: 0,
            autostart,
            tf_timeout_secs: 0.5,
            max_delay_secs: 5.0,
            controller: "joint_trajectory_controller/follow_joint_trajectory".into(),
            controller_timeout_secs: 2.0,
            controller_grace_secs: 5.0,
            model_path,
            robot: files,
        };
        let mut warnings = Vec::new();
        for (name, value) in values {
            let parameters = state.parameters();
            match find(&parameters, &name) {
                Some(parameter) => {
                    let value = parameter.accept(value).map_err(bad_request)?;
                    state.apply(&name, value)?;
                }
                // A file may hold parameters of several nodes, so this is no reason to stop.
                None => warnings.push(format!(
                    "there is no parameter {name}, so it has no effect; {}",
                    suggestion(&parameters, &name)
                )),
            }
        }
        Ok((state, warnings))
    }

    /// Leads it to another state.
    pub fn move_to(&mut self, lifecycle: Lifecycle) {
        self.lifecycle = lifecycle;
        if lifecycle == Lifecycle::Active {
            self.activations += 1;
        }
    }

    /// Which time it is that the node is active; none while it is not.
    pub fn activation(&self) -> Option<u64> {
        (self.lifecycle == Lifecycle::Active).then_some(self.activations)
    }

    /// Path of the model; empty for the built-in one.
    pub fn model_path(&self) -> &str {
        &self.model_path
    }

    /// Where the robot comes from, with the frames that are used.
    pub fn robot_files(&self) -> &RobotFiles {
        &self.robot
    }

    /// All parameters as they are now, in the order of their names.
    pub fn parameters(&self) -> Vec<Parameter> {
        use ParameterValue as P;
        let settings = self.server.settings();
        let mut parameters = Vec::new();
        let mut add = |name: &str, description: &str, range, value| {
            parameters.push(Parameter {
                name: name.into(),
                description: description.into(),
                range,
                read_only: name == AUTOSTART || FIXED.iter().any(|(fixed, _)| *fixed == name),
                value,
            });
        };
        add(
            "model_path",
            "Model file that is served; empty for the built-in one. Loaded when set; a file that \
             does not fit is refused, and the old model stays",
            Range::Any,
            P::String(self.model_path.clone()),
        );
        let RobotFiles { robot_path, urdf_path, base_frame, tip_link } = &self.robot;
        let fixed = [robot_path, urdf_path, base_frame, tip_link];
        for ((name, description), value) in FIXED.into_iter().zip(fixed) {
            add(name, description, Range::Any, P::String(value.clone()));
        }
        add(
            AUTOSTART,
            "Whether the node is active from the start; if not, a lifecycle manager, or ros2 lifecycle set, \
             configures and activates it",
            Range::Any,
            P::Boolean(self.autostart),
        );
        add(
            "publish_on_task",
            "Whether every task topic asks for a trajectory, as the goal pose does",
            Range::Any,
            P::Boolean(self.publish_on_task),
        );
        add(
            "use_sim_time",
            "Whether stamps are taken from /clock",
            Range::Any,
            P::Boolean(self.use_sim_time),
        );
        add(
            "tf.timeout_s",
            "How long (s) a location in another frame waits for its transform, counted from its receipt",
            Range::Double(0.0, 60.0),
            P::Double(self.tf_timeout_secs),
        );
        add(
            "execute.controller",
            "The control_msgs/action/FollowJointTrajectory action that drives the goals of ~/execute; a relative \
             name is one in the node's namespace, and empty means none",
            Range::Any,
            P::String(self.controller.clone()),
        );
        add(
            "execute.timeout_s",
            "How long (s) the controller may take to appear, to accept a motion, and to stop",
            Range::Double(0.1, 60.0),
            P::Double(self.controller_timeout_secs),
        );
        add(
            "execute.grace_s",
            "How much longer (s) than planned the controller may take before it is told to stop",
            Range::Double(0.0, 3600.0),
            P::Double(self.controller_grace_secs),
        );
        add(
            "task.tolerance_m",
            "Largest distance (m) between a location and where the checked motion puts it",
            Range::Double(1e-4, 1.0),
            P::Double(settings.tolerance_m),
        );
        add(
            "task.max_age_s",
            "Oldest task (s) that is served, counted from its receipt; 0 for any age",
            Range::Double(0.0, 1e9),
            P::Double(settings.max_age_secs),
        );
        add(
            "task.max_delay_s",
            "How much longer (s) than other messages of its publisher one that asks for a motion may have been on its \
             way, as when the network was gone; 0 for any time",
            Range::Double(0.0, 3600.0),
            P::Double(self.max_delay_secs),
        );
        for (location, xy) in &self.defaults {
            add(
                &default_name(location),
                &format!(
                    "Where {location} is, [x, y] in m in the base frame, while none was \
                     published; empty for nowhere"
                ),
                Range::Any,
                P::DoubleArray(xy.map(Vec::from).unwrap_or_default()),
            );
        }
        add(
            "manner.mode",
            "Where the manner comes from: the manner parameters, or a draw from the prior for \
             every motion",
            Range::OneOf(&["fixed", "prior"]),
            P::String(match settings.manner_mode {
                MannerMode::Fixed => "fixed".into(),
                MannerMode::Prior => "prior".into(),
            }),
        );
        let axes = self.server.model().primitive.manner_space().axes();
        for (axis, value) in axes.iter().zip(self.server.manner()) {
            add(
                &manner_name(&axis.name),
                &format!("Standard deviations of the prior; {}", axis.effect),
                Range::Double(axis.lower, axis.upper),
                P::Double(*value),
            );
        }
        add(
            "sample.seed",
            "Seed of every draw; setting it starts the sequence again",
            Range::Integer(0, MOST_SEED),
            P::Integer(i64::try_from(settings.seed).unwrap_or(MOST_SEED)),
        );
        add(
            "sample.max_tries",
            "Draws until a motion passes every check",
            Range::Integer(1, 1000),
            P::Integer(settings.max_tries.into()),
        );
        add(
            "sample.speed",
            "How many times as fast as it was learned a motion is made, where the limits allow it",
            Range::Double(SPEEDS[0], SPEEDS[1]),
            P::Double(settings.speed),
        );
        add(
            "limits.velocity_scale",
            "Share of the joints' velocity limits that may be used",
            Range::Double(0.01, 1.0),
            P::Double(settings.velocity_scale),
        );
        add(
            "limits.acceleration_scale",
            "Share of the joints' acceleration limits that may be used",
            Range::Double(0.01, 1.0),
            P::Double(settings.acceleration_scale),
        );
        add(
            "start.policy",
            "What happens where the arm is not at the first point of the motion: it is brought there \
             first, or the motion is refused, or nobody cares",
            Range::OneOf(&["approach", "refuse", "ignore"]),
            P::String(match settings.start_policy {
                StartPolicy::Approach => "approach".into(),
                StartPolicy::Refuse => "refuse".into(),
                StartPolicy::Ignore => "ignore".into(),
            }),
        );
        add(
            "start.tolerance_rad",
            "Largest distance (rad) of a joint from the first point that start.policy refuse allows",
            Range::Double(0.0, 3.2),
            P::Double(settings.start_tolerance_rad),
        );
        add(
            "start.max_age_s",
            "Oldest /joint_states (s) that tell where the arm is, counted from their receipt",
            Range::Double(0.01, 3600.0),
            P::Double(settings.start_max_age_secs),
        );
        add(
            "collision.clearance_m",
            "Smallest distance (m) that the arm leaves to itself and to the table",
            Range::Double(0.0, 1.0),
            P::Double(self.server.robot().clearance_m),
        );
        add(
            "collision.table_height_m",
            "Height (m) of the table in the base frame; -10 for no table",
            Range::Double(NO_TABLE_M, 10.0),
            P::Double(self.server.table_height_m().unwrap_or(NO_TABLE_M)),
        );
        add(
            "out_of_distribution",
            "What happens to a task outside the trained region: refused, or served with a warning",
            Range::OneOf(&["reject", "warn"]),
            P::String(match settings.out_of_distribution {
                OutOfDistribution::Reject => "reject".into(),
                OutOfDistribution::Warn => "warn".into(),
            }),
        );
        parameters.sort_by(|a, b| a.name.cmp(&b.name));
        parameters
    }

    /// Sets a parameter. `loaded` are the models that the caller has read for `model_path`.
    ///
    /// # Errors
    /// The reason, for a person; then the state may be half changed, so the caller throws it away.
    pub fn set(
        &mut self,
        name: &str,
        value: ParameterValue,
        loaded: &[Loaded],
    ) -> Result<(), String> {
        let parameters = self.parameters();
        let Some(parameter) = find(&parameters, name) else {
            return Err(format!("there is no parameter {name}; {}", suggestion(&parameters, name)));
        };
        let value = parameter.accept(value)?;
        if parameter.read_only {
            return match value == parameter.value {
                true => Ok(()),
                false => Err(format!(
                    "{name} is fixed at start; start the node with -p {name}:=… to change it"
                )),
            };
        }
        match value {
            ParameterValue::String(path) if name == "model_path" => {
                match loaded.iter().find(|loaded| loaded.path == path) {
                    Some(loaded) => self.load(loaded.clone()).map_err(|e| e.to_string()),
                    None => Err(format!("{path} was not read; set model_path again")),
                }
            }
            value => self.apply(name, value).map_err(|e| e.to_string()),
        }
    }

    /// Serves this model from now on.
    ///
    /// # Errors
    /// [`ErrorCode::RobotMismatch`]; then nothing changes.
    pub fn load(&mut self, loaded: Loaded) -> Result<(), Refusal> {
        self.server.load_model(loaded.model)?;
        self.model_path = loaded.path;
        let old = std::mem::replace(&mut self.defaults, no_defaults(&self.server));
        for (name, default) in &mut self.defaults {
            *default = old.iter().find(|(n, _)| n == name).and_then(|(_, xy)| *xy);
        }
        Ok(())
    }

    /// Sets a parameter that exists to a value that it accepts.
    fn apply(&mut self, name: &str, value: ParameterValue) -> Result<(), Refusal> {
        use ParameterValue as P;
        let mut settings = self.server.settings().clone();
        match (name, value) {
            ("publish_on_task", P::Boolean(value)) => self.publish_on_task = value,
            ("use_sim_time", P::Boolean(value)) => self.use_sim_time = value,
            ("tf.timeout_s", P::Double(value)) => self.tf_timeout_secs = value,
            ("task.max_delay_s", P::Double(value)) => self.max_delay_secs = value,
            ("execute.timeout_s", P::Double(value)) => self.controller_timeout_secs = value,
            ("execute.grace_s", P::Double(value)) => self.controller_grace_secs = value,
            ("execute.controller", P::String(value)) => {
                let name = value.trim();
                let anybody = NodeNames::new("anybody", &[]);
                if !name.is_empty() {
                    anybody
                        .and_then(|names| names.service(name))
                        .map_err(|e| bad_request(e.to_string()))?;
                }
                self.controller = name.to_owned();
            }
            ("task.tolerance_m", P::Double(value)) => settings.tolerance_m = value,
            ("task.max_age_s", P::Double(value)) => settings.max_age_secs = value,
            ("manner.mode", P::String(value)) => {
                settings.manner_mode = match value.as_str() {
                    "prior" => MannerMode::Prior,
                    _ => MannerMode::Fixed,
                }
            }
            ("sample.seed", P::Integer(value)) => settings.seed = value.unsigned_abs(),
            ("sample.max_tries", P::Integer(value)) => {
                settings.max_tries = u32::try_from(value).unwrap_or(u32::MAX);
            }
            ("sample.speed", P::Double(value)) => settings.speed = value,
            ("limits.velocity_scale", P::Double(value)) => settings.velocity_scale = value,
            ("limits.acceleration_scale", P::Double(value)) => settings.acceleration_scale = value,
            ("start.tolerance_rad", P::Double(value)) => settings.start_tolerance_rad = value,
            ("start.max_age_s", P::Double(value)) => settings.start_max_age_secs = value,
            ("start.policy", P::String(value)) => {
                settings.start_policy = match value.as_str() {
                    "refuse" => StartPolicy::Refuse,
                    "ignore" => StartPolicy::Ignore,
                    _ => StartPolicy::Approach,
                }
            }
            ("collision.clearance_m", P::Double(value)) => {
                self.server.set_surroundings(self.server.table_height_m(), value)?;
            }
            ("collision.table_height_m", P::Double(value)) => {
                let table = (value > NO_TABLE_M).then_some(value);
                self.server.set_surroundings(table, self.server.robot().clearance_m)?;
            }
            ("out_of_distribution", P::String(value)) => {
                settings.out_of_distribution = match value.as_str() {
                    "warn" => OutOfDistribution::Warn,
                    _ => OutOfDistribution::Reject,
                }
            }
            (name, P::DoubleArray(values)) => {
                let xy = match values.as_slice() {
                    [] => None,
                    &[x, y] => Some([x, y]),
                    _ => {
                        return Err(bad_request(format!(
                            "{name} has {} values; it takes [x, y], or [] for nowhere",
                            values.len()
                        )));
                    }
                };
                let location = self.defaults.iter_mut().find(|(l, _)| default_name(l) == name);
                let (location, default) = location.expect("the parameter exists");
                self.server.set_default_location(location, xy)?;
                *default = xy;
            }
            (name, P::Double(value)) => {
                let axis = name.strip_prefix("manner.").expect("the parameter exists");
                self.server.set_manner(&[axis.to_owned()], &[value], false)?;
            }
            (name, value) => {
                return Err(Refusal::new(
                    ErrorCode::Internal,
                    format!("{name} accepted {value:?} and can't set it; please report this"),
                ));
            }
        }
        self.server.set_settings(settings)
    }
}

fn no_defaults(server: &PrimitiveServer) -> Vec<(String, Option<[f64; 2]>)> {
    server.model().space().locations().iter().map(|l| (l.name.clone(), None)).collect()
}

/// The parameter that a location's default is.
fn default_name(location: &str) -> String {
    format!("task.{location}.default")
}

/// The parameter that a manner parameter is.
fn manner_name(axis: &str) -> String {
    format!("manner.{axis}")
}

fn bad_request(message: String) -> Refusal {
    Refusal::new(ErrorCode::BadRequest, message)
}
