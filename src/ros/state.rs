//! What the node's parameters are, and what setting one does: a view of the
//! [`PrimitiveServer`] and of a few settings of the node itself.

use std::collections::BTreeMap;
use std::sync::Arc;

use ros2_client::ParameterValue;

use super::parameters::{Parameter, Range, find, suggestion};
use crate::serving::{
    ErrorCode, MannerMode, OutOfDistribution, PrimitiveServer, Refusal, Robot, ServedModel,
    Settings,
};

/// Reads models and robots from files; an empty path means the built-in one. The binary provides
/// it, since files are its business.
pub trait Loader: Send + Sync {
    /// The model at this path.
    ///
    /// # Errors
    /// [`ErrorCode::BadFile`], [`ErrorCode::FormatVersion`].
    fn model(&self, path: &str) -> Result<ServedModel, Refusal>;

    /// The arm from `base_frame` to `tip_link` in the description at this path.
    ///
    /// # Errors
    /// [`ErrorCode::BadFile`], [`ErrorCode::RobotMismatch`].
    fn robot(&self, path: &str, base_frame: &str, tip_link: &str) -> Result<Robot, Refusal>;
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
    /// Link that positions are given in.
    pub base_frame: String,
    /// Link that moves.
    pub tip_link: String,
    model_path: String,
    urdf_path: String,
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

/// The parameters that are fixed at start, their built-in values, and what they are for.
const FIXED: [(&str, &str, &str); 3] = [
    ("urdf_path", "", "Robot description (URDF file); empty for the built-in Baxter"),
    ("base_frame", "base", "Link that all positions are given in"),
    ("tip_link", "left_gripper", "Link that the motion moves"),
];

impl NodeState {
    /// The state at start, with these parameters; and warnings of those that there are not.
    ///
    /// # Errors
    /// A file that can't be read or does not fit, a value that is not accepted.
    pub fn new(
        mut values: BTreeMap<String, ParameterValue>,
        loader: &dyn Loader,
    ) -> Result<(Self, Vec<String>), Refusal> {
        let mut text = |name: &str, built_in: &str| match values.remove(name) {
            None => Ok(built_in.to_owned()),
            Some(ParameterValue::String(text)) => Ok(text),
            Some(_) => Err(bad_request(format!("{name} is not a string; write {name}:='…'"))),
        };
        let model_path = text("model_path", "")?;
        let [urdf_path, base_frame, tip_link] =
            FIXED.map(|(name, built_in, _)| text(name, built_in));
        let (urdf_path, base_frame, tip_link) = (urdf_path?, base_frame?, tip_link?);
        let robot = loader.robot(&urdf_path, &base_frame, &tip_link)?;
        let model = loader.model(&model_path)?;
        let server = PrimitiveServer::new(Arc::new(model), Arc::new(robot), Settings::default())?;
        let mut state = Self {
            defaults: no_defaults(&server),
            server,
            publish_on_task: false,
            use_sim_time: false,
            base_frame,
            tip_link,
            model_path,
            urdf_path,
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

    /// Path of the model; empty for the built-in one.
    pub fn model_path(&self) -> &str {
        &self.model_path
    }

    /// Path of the robot's description; empty for the built-in one.
    pub fn urdf_path(&self) -> &str {
        &self.urdf_path
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
                read_only: FIXED.iter().any(|(fixed, ..)| *fixed == name),
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
        let fixed = [&self.urdf_path, &self.base_frame, &self.tip_link];
        for ((name, _, description), value) in FIXED.into_iter().zip(fixed) {
            add(name, description, Range::Any, P::String(value.clone()));
        }
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
            "Where the manner comes from: the parameters below, or a draw from the prior for \
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
            Range::Integer(0, i64::MAX),
            P::Integer(i64::try_from(settings.seed).unwrap_or(i64::MAX)),
        );
        add(
            "sample.max_tries",
            "Draws until a motion passes every check",
            Range::Integer(1, 1000),
            P::Integer(settings.max_tries.into()),
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
            "start.tolerance_rad",
            "Largest distance (rad) of a joint from the start that a request gives",
            Range::Double(0.0, 3.2),
            P::Double(settings.start_tolerance_rad),
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
            ("limits.velocity_scale", P::Double(value)) => settings.velocity_scale = value,
            ("limits.acceleration_scale", P::Double(value)) => settings.acceleration_scale = value,
            ("start.tolerance_rad", P::Double(value)) => settings.start_tolerance_rad = value,
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
