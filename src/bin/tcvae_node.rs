//! The ROS 2 node. Without arguments it serves the embedded pouring model on the embedded Baxter
//! description.

use std::io::Write;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;

use tcvae::artifact::{Artifact, ArtifactError};
use tcvae::config::{self, BAXTER_URDF};
use tcvae::demonstrations::recording::RobotConfig;
use tcvae::kinematics::CollisionRules;
use tcvae::ros::arguments::{Arguments, Command, HELP};
use tcvae::ros::environment::Environment;
use tcvae::ros::log::NodeLog;
use tcvae::ros::names::NodeNames;
use tcvae::ros::node::RunningNode;
use tcvae::ros::state::{Loader, NodeState, RobotFiles};
use tcvae::serving::{ErrorCode, Refusal, Robot, ServedModel};
use tcvae::urdf::{self, UrdfError};
use tokio::signal::unix::{SignalKind, signal};

/// The model that is served without a file.
const POURING: &[u8] = include_bytes!("../../models/pouring.safetensors");

/// Reads models and robots from files; an empty path means the embedded one.
struct Files;

impl Loader for Files {
    fn model(&self, path: &str) -> Result<ServedModel, Refusal> {
        check_regular(path)?;
        let artifact = match path {
            "" => Artifact::from_bytes(POURING),
            path => Artifact::load(Path::new(path)),
        };
        artifact.and_then(|artifact| artifact.served_model()).map_err(|e| {
            let code = match e {
                ArtifactError::Version { .. } => ErrorCode::FormatVersion,
                ArtifactError::NoRobot { .. } => ErrorCode::RobotMismatch,
                _ => ErrorCode::BadFile,
            };
            let message = match (&e, path) {
                // It names the file itself.
                (ArtifactError::Io { .. }, _) => e.to_string(),
                (_, "") => format!("the built-in model: {e}"),
                (_, path) => format!("{path}: {e}"),
            };
            Refusal::new(code, message)
        })
    }

    fn robot(&self, files: &RobotFiles) -> Result<Robot, Refusal> {
        let RobotFiles { robot_path, urdf_path, base_frame, tip_link } = files;
        check_regular(files.path())?;
        if !robot_path.is_empty() {
            let robot = config::robot(Some(Path::new(robot_path)), urdf::arm);
            return robot
                .map(|robot| robot.served())
                .map_err(|e| Refusal::new(ErrorCode::BadFile, e.to_string()));
        }
        let (urdf, rules) = match urdf_path.as_str() {
            "" => (BAXTER_URDF.to_owned(), RobotConfig::default().collision),
            path => {
                let urdf = config::text(Path::new(path))
                    .map_err(|e| Refusal::new(ErrorCode::BadFile, format!("{path}: {e}")))?;
                (urdf, CollisionRules::default())
            }
        };
        let file = if urdf_path.is_empty() { "the built-in robot" } else { urdf_path };
        let arm = urdf::arm(&urdf, base_frame, tip_link).map_err(|e| {
            let code = match e {
                UrdfError::Parse(_) => ErrorCode::BadFile,
                _ => ErrorCode::RobotMismatch,
            };
            let hint = match urdf_path.as_str() {
                "" => "; give the robot that the model was made for by --robot or --urdf",
                _ => "",
            };
            Refusal::new(code, format!("{file}: {e}{hint}"))
        })?;
        Robot::new(arm, &rules, &urdf)
            .map_err(|e| Refusal::new(ErrorCode::RobotMismatch, format!("{file}: {e}")))
    }
}

/// A path that a client names may be a device or a pipe, which would never end.
fn check_regular(path: &str) -> Result<(), Refusal> {
    match std::fs::metadata(path) {
        Ok(metadata) if !metadata.is_file() => {
            Err(Refusal::new(ErrorCode::BadFile, format!("{path} is not a file")))
        }
        // What can't be read says so when it is read.
        _ => Ok(()),
    }
}

/// Exit code of wrong usage: the command line, the environment, the network.
const WRONG_USAGE: u8 = 2;
/// Exit code of files that can't be served.
const BAD_DATA: u8 = 3;

fn main() -> ExitCode {
    let done = match Arguments::parse(std::env::args().skip(1)) {
        Ok(Command::Help) => print(HELP),
        Ok(Command::Version) => print(concat!("tcvae_node ", env!("CARGO_PKG_VERSION"), "\n")),
        Ok(Command::Run(arguments)) => run(&arguments),
        Err(e) => Err(e.into()),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            // Each message holds its causes.
            eprintln!("tcvae_node: {e}");
            let code = e.downcast_ref::<Refusal>().map(|refusal| refusal.code);
            ExitCode::from(match code {
                Some(ErrorCode::BadFile | ErrorCode::FormatVersion | ErrorCode::RobotMismatch) => {
                    BAD_DATA
                }
                _ => WRONG_USAGE,
            })
        }
    }
}

fn print(text: &str) -> anyhow::Result<()> {
    Ok(std::io::stdout().write_all(text.as_bytes())?)
}

fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let names = NodeNames::new("tcvae", &arguments.remaps)?;
    let environment = Environment::read(|name| std::env::var(name).ok())?;
    let values = arguments.overrides(&names, config::text)?;
    let log = NodeLog::install(&names.logger(), arguments)?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_io()
        .enable_time()
        .build()?;
    let (state, mut warnings) = NodeState::new(values, &Files)?;
    warnings.extend(environment.warnings.iter().cloned());
    let ignored = arguments.ignored.iter().map(|flag| format!("{flag} has no effect on this node"));
    warnings.extend(ignored);
    let done = runtime.block_on(async {
        // Before the node is on the graph, so that no signal finds the default handler.
        let mut interrupt = signal(SignalKind::interrupt())?;
        let mut terminate = signal(SignalKind::terminate())?;
        let node =
            RunningNode::start(names, &environment, state, Arc::new(Files), log, arguments.rosout)?;
        for warning in warnings {
            log::warn!("{warning}");
        }
        // A closed standard output is no reason not to serve.
        let _ = print(&node.banner(&environment));
        let name = tokio::select! {
            _ = interrupt.recv() => "SIGINT",
            _ = terminate.recv() => "SIGTERM",
        };
        log::info!("{name}: leaving");
        node.stop().await;
        Ok(())
    });
    // A model file that is still being read is not waited for.
    runtime.shutdown_background();
    done
}
