//! A model on the other arm: what it learned, as its mirror image in the plane of the base's x and z shows it.

use std::sync::Arc;

use rand::Rng;

use crate::kinematics::RobotRecord;
use crate::parameters::{MannerAxis, MannerParameters, MannerSpace, TaskParameters, TaskSpace};
use crate::pose::mirrored_states;
use crate::primitive::{Generated, MannerConditioned, MovementPrimitive};
use crate::serving::{OtherArm, Robot, ServedModel};

/// The model for the arm that is the mirror image of its own; none where the robot has no such arm, or the task
/// is another one when mirrored.
pub(super) fn mirrored(model: &Arc<ServedModel>, robot: &Robot) -> Option<ServedModel> {
    let OtherArm { joint_names, signs } = robot.mirrors.as_ref()?;
    let RobotRecord { joint_names: its, .. } = &model.robot;
    if its != joint_names {
        return None;
    }
    let task = model.task.mirrored()?;
    let (chain, primitive) = (&robot.chain, Mirrored::new(model));
    Some(ServedModel {
        model_id: model.model_id.clone(),
        method: model.method.clone(),
        task,
        frame: model.frame.mirrored(),
        duration_secs: model.duration_secs,
        robot: model.robot.mirrored(chain.joint_names(), chain.tip_frame(), signs),
        evaluation_json: model.evaluation_json.clone(),
        synthetic_data: model.synthetic_data,
        mirrored: true,
        familiarity: model.familiarity.mirrored(),
        primitive: Box::new(primitive),
    })
}

/// A primitive that makes the mirror images of another's motions, for the mirror images of its tasks.
#[derive(Debug)]
struct Mirrored {
    model: Arc<ServedModel>,
    task_space: TaskSpace,
    manner_space: MannerSpace,
}

impl Mirrored {
    fn new(model: &Arc<ServedModel>) -> Self {
        // What was measured is an effect on the other arm: a turn to the left is one to the right here.
        let axis = |axis: &MannerAxis| MannerAxis {
            effect: format!("{} (as the other arm shows it)", axis.effect),
            ..axis.clone()
        };
        let axes = model.primitive.manner_space().axes().iter().map(axis).collect();
        Self {
            task_space: model.space().mirrored(),
            manner_space: MannerSpace::new(axes).expect("the names and bounds of another space"),
            model: Arc::clone(model),
        }
    }
}

fn image(generated: Generated) -> Generated {
    // Deviations have no sign.
    Generated { mean: mirrored_states(&generated.mean), ..generated }
}

impl MovementPrimitive for Mirrored {
    fn task_space(&self) -> &TaskSpace {
        &self.task_space
    }

    fn steps(&self) -> usize {
        self.model.primitive.steps()
    }

    fn state_dim(&self) -> usize {
        self.model.primitive.state_dim()
    }

    fn generate(&self, w: &TaskParameters) -> Generated {
        image(self.model.primitive.generate(&w.mirrored()))
    }
}

impl MannerConditioned for Mirrored {
    fn manner_space(&self) -> &MannerSpace {
        &self.manner_space
    }

    fn decode(&self, w: &TaskParameters, h: &MannerParameters) -> Generated {
        image(self.model.primitive.decode(&w.mirrored(), h))
    }

    fn sample_manner(&self, rng: &mut dyn Rng) -> MannerParameters {
        self.model.primitive.sample_manner(rng)
    }

    fn manner(&self, latents: &[f64]) -> MannerParameters {
        self.model.primitive.manner(latents)
    }

    fn decode_latents(&self, w: &TaskParameters, latents: &[f64]) -> Generated {
        image(self.model.primitive.decode_latents(&w.mirrored(), latents))
    }

    fn has_learned_prior(&self) -> bool {
        self.model.primitive.has_learned_prior()
    }
}
