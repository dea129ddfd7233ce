//! What the node prints at start: what it serves, how good that was measured to be, and commands
//! to try.

use std::fmt::Write;

use super::convert::Frames;
use super::environment::{DiscoveryRange, Environment};
use super::names::NodeNames;
use crate::evaluation::{ModelEvaluation, Score};
use crate::parameters::{Interval, MannerAxis, TaskLocation};
use crate::serving::Description;

/// What the banner tells of.
#[derive(Debug, Clone, Copy)]
pub struct Banner<'a> {
    /// What is served.
    pub description: &'a Description,
    /// The locations of the task.
    pub locations: &'a [TaskLocation],
    /// A task to try, one `(x, y)` for each location.
    pub example: &'a [[f64; 2]],
    /// Where the model comes from; empty for the built-in one.
    pub model_path: &'a str,
    /// Where the robot comes from; empty for the built-in one.
    pub robot_path: &'a str,
    /// What keeps the arm from touching what.
    pub clearance: &'a str,
    /// The frames.
    pub frames: &'a Frames,
    /// The node's names.
    pub names: &'a NodeNames,
    /// The network.
    pub environment: &'a Environment,
}

impl Banner<'_> {
    /// The text, several lines.
    pub fn text(&self) -> String {
        let Self { description, locations, frames, names, environment, .. } = self;
        let reach = match environment.range {
            DiscoveryRange::Off => "found by nobody",
            DiscoveryRange::Localhost => "this machine only",
            DiscoveryRange::Subnet => "the whole subnet",
        };
        let source = |path: &str| match path {
            "" => "built in".to_owned(),
            path => path.to_owned(),
        };
        let data = match description.synthetic_data {
            true => "synthetic",
            false => "recorded",
        };
        let mirrored = if description.mirrored { " of the other arm, mirrored" } else { "" };
        let mut text = format!(
            "tcvae {} serves {} as {names} in domain {} ({reach})\n  \
             model   {} {} ({}), trained on {data} demonstrations{mirrored}\n  \
             robot   {} ({}), {} joints from {} to {}\n  \
             body    {}\n",
            env!("CARGO_PKG_VERSION"),
            description.primitive,
            environment.domain,
            description.method,
            description.model_id,
            source(self.model_path),
            description.robot,
            source(self.robot_path),
            description.joint_names.len(),
            frames.base,
            frames.tip,
            self.clearance,
        );
        let unit = "m";
        for line in scores(&description.evaluation_json, unit) {
            let _ = writeln!(text, "  scores  {line}");
        }
        for location in *locations {
            let range = |i: Interval| format!("{:.2} to {:.2}", i.lower, i.upper);
            let _ = writeln!(
                text,
                "  task    {}: x {}, y {} {unit} in {}",
                location.name,
                range(location.x),
                range(location.y),
                frames.base
            );
        }
        for axis in &description.manner {
            let _ = writeln!(
                text,
                "  manner  {}: {} to {}, {}",
                axis.name, axis.lower, axis.upper, axis.effect
            );
        }
        text.push_str("Try, in another shell:\n");
        for command in self.commands() {
            let _ = writeln!(text, "  {command}");
        }
        text
    }

    fn commands(&self) -> Vec<String> {
        let topic = |name: &str| self.names.topic(name).unwrap_or_else(|_| name.into());
        let service = |name: &str| self.names.service(name).unwrap_or_else(|_| name.into());
        let mut commands =
            vec![format!("ros2 topic echo --once {} &", topic("~/joint_trajectory"))];
        let base = &self.frames.base;
        let examples = self.locations.iter().zip(self.example).skip(1);
        commands.extend(examples.map(|(l, xy)| location_command(self.names, base, &l.name, *xy)));
        if let Some([x, y]) = self.example.first() {
            commands.push(format!(
                "ros2 topic pub --once {} geometry_msgs/msg/PoseStamped '{{header: {{frame_id: \
                 {base}}}, pose: {{position: {{x: {x:.2}, y: {y:.2}}}}}}}'",
                topic("~/goal_pose")
            ));
        }
        commands.push(format!("ros2 service call {} std_srvs/srv/Trigger", service("~/sample")));
        // One that does something: its effect begins with a number.
        let told = |axis: &&MannerAxis| axis.effect.starts_with(['+', '-']);
        if let Some(axis) = self.description.manner.iter().find(told) {
            commands.push(format!("ros2 param set {} manner.{} 1.0", self.names, axis.name));
        }
        commands
    }
}

/// The command that publishes a location of the task.
pub fn location_command(names: &NodeNames, base: &str, location: &str, xy: [f64; 2]) -> String {
    let [x, y] = xy;
    let topic = format!("~/{location}");
    format!(
        "ros2 topic pub --once {} geometry_msgs/msg/PointStamped \
         '{{header: {{frame_id: {base}}}, point: {{x: {x:.2}, y: {y:.2}}}}}'",
        names.topic(&topic).unwrap_or(topic),
    )
}

/// The stored scores, for a person.
fn scores(evaluation_json: &str, unit: &str) -> Vec<String> {
    let Ok(evaluation) = serde_json::from_str::<ModelEvaluation>(evaluation_json) else {
        return vec!["none are stored in the model".into()];
    };
    let line = |name: &str, scores: &[Score]| {
        let scores = scores.iter().map(|s| {
            format!("{:.3} [{:.3}, {:.3}] within {} {unit}", s.mean, s.low, s.high, s.threshold)
        });
        format!("{name} {}", scores.collect::<Vec<_>>().join(", "))
    };
    match evaluation {
        ModelEvaluation::TcVae(evaluation) => vec![
            line("success", &evaluation.success),
            line("robustness", &evaluation.robustness),
            line("robust and valid", &evaluation.robust_and_valid),
            format!(
                "{} active latents, leak R2 {:.3}, {} test cases",
                evaluation.active_latents, evaluation.leak_r2, evaluation.cases
            ),
        ],
        ModelEvaluation::Classical(evaluation) => vec![
            line("success", &evaluation.success),
            line("success and valid", &evaluation.success_and_valid),
            format!("no manner parameters, {} test cases", evaluation.cases),
        ],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EVALUATION: &str = r#"{
        "success": [{"threshold": 0.02, "mean": 0.91, "low": 0.89, "high": 0.93}],
        "robustness": [{"threshold": 0.02, "mean": 0.88, "low": 0.86, "high": 0.9}],
        "robust_and_valid": [{"threshold": 0.02, "mean": 0.85, "low": 0.83, "high": 0.87}],
        "active_latents": 3, "reconstruction_rmse": 0.01, "leak_r2": 0.04, "swap": 0.9,
        "cases": 400, "seed": 1, "model_id": "0123456789ab", "data_digest": ""
    }"#;

    fn text(evaluation_json: &str) -> String {
        let interval = |lower, upper| Interval { lower, upper };
        let location = |name: &str| TaskLocation {
            name: name.into(),
            x: interval(0.5, 0.8),
            y: interval(0.1, 0.5),
        };
        let description = Description {
            model_id: "0123456789ab".into(),
            method: "TC-VAE".into(),
            primitive: "pouring".into(),
            task_names: vec![],
            task_lower: vec![],
            task_upper: vec![],
            manner: vec![MannerAxis {
                name: "pour_duration".into(),
                lower: -3.0,
                upper: 3.0,
                effect: "+0.6 s above 70 degrees per unit (R2 0.91)".into(),
            }],
            manner_values: vec![0.0],
            evaluation_json: evaluation_json.into(),
            robot: "baxter".into(),
            joint_names: vec!["left_s0".into(); 7],
            synthetic_data: true,
            mirrored: true,
        };
        let rules = super::super::names::Remap {
            node: None,
            from: super::super::names::RemapFrom::Namespace,
            to: "/left".into(),
        };
        Banner {
            description: &description,
            locations: &[location("pour_location"), location("source_cup")],
            example: &[[0.65, 0.3], [0.6, 0.1]],
            model_path: "",
            robot_path: "my.urdf",
            clearance: "9 shapes, 0.01 m off each other; no table",
            frames: &Frames { base: "base".into(), tip: "left_gripper".into() },
            names: &NodeNames::new("tcvae", &[rules]).unwrap(),
            environment: &Environment::read(|_| None).unwrap(),
        }
        .text()
    }

    #[test]
    fn the_banner_tells_what_is_served_and_what_to_try() {
        let text = text(EVALUATION);
        for expected in [
            "serves pouring as /left/tcvae in domain 0 (the whole subnet)",
            "model   TC-VAE 0123456789ab (built in), trained on synthetic demonstrations of the other arm, \
             mirrored",
            "robot   baxter (my.urdf), 7 joints from base to left_gripper",
            "body    9 shapes, 0.01 m off each other; no table",
            "scores  robustness 0.880 [0.860, 0.900] within 0.02 m",
            "scores  3 active latents, leak R2 0.040, 400 test cases",
            "manner  pour_duration: -3 to 3, +0.6 s above 70 degrees per unit (R2 0.91)",
            "ros2 topic pub --once /left/tcvae/source_cup geometry_msgs/msg/PointStamped \
             '{header: {frame_id: base}, point: {x: 0.60, y: 0.10}}'",
            "ros2 topic pub --once /left/tcvae/goal_pose geometry_msgs/msg/PoseStamped \
             '{header: {frame_id: base}, pose: {position: {x: 0.65, y: 0.30}}}'",
            "ros2 param set /left/tcvae manner.pour_duration 1.0",
        ] {
            assert!(text.contains(expected), "{expected}\nis not in\n{text}");
        }
    }

    #[test]
    fn of_a_primitive_without_manner_it_tells_what_there_is() {
        let evaluation = r#"{
            "success": [{"threshold": 0.02, "mean": 0.91, "low": 0.89, "high": 0.93}],
            "success_and_valid": [{"threshold": 0.02, "mean": 0.9, "low": 0.88, "high": 0.92}],
            "broken_bounds": {}, "median_task_error": 0.004, "reconstruction_rmse": 0.01,
            "cases": 42, "seed": 0, "model_id": "0123456789ab", "data_digest": ""
        }"#;
        let text = text(evaluation);
        for expected in [
            "scores  success 0.910 [0.890, 0.930] within 0.02 m",
            "scores  success and valid 0.900 [0.880, 0.920] within 0.02 m",
            "scores  no manner parameters, 42 test cases",
        ] {
            assert!(text.contains(expected), "{expected}\nis not in\n{text}");
        }
    }

    #[test]
    fn a_model_without_scores_says_so() {
        assert!(text("null").contains("scores  none are stored in the model"));
    }
}
