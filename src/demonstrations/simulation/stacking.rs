//! People who put a block on another one.

use nalgebra::Vector3;
use rand::RngExt;
use rand::rngs::ChaCha8Rng;

use super::plan::{Move, Plan};
use super::scene::Scene;
use super::{Simulation, Truth, normal};
use crate::demonstrations::recording::{Reason, Workplace};

/// Edge of a block.
const BLOCK_M: f64 = 0.05;
/// The block has left its place, and arrived at the other, when it is this far from it over the ground.
const AWAY_M: f64 = 0.02;

/// One demonstration of stacking as it is meant.
pub(super) struct Stack {
    pub(super) plan: Plan,
}

impl Stack {
    pub(super) fn draw(
        simulation: &Simulation,
        trap: Option<Reason>,
        workplace: &Workplace,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let scene = Scene::draw(simulation.correlation, trap, workplace, rng);
        let manner = Manner::draw(simulation, &scene, rng);
        let start = rng.random_range(0.4..1.4);
        let (mut plan, [behind, far]) = Plan::behind(&scene, rng);
        let mut clock = plan.reach(start, behind, -far, rng) + rng.random_range(0.25..0.6);
        plan.gripper_changes.push(clock);

        let source = scene.grasp.translation.vector;
        let mut way = scene.target - source;
        way.z = BLOCK_M + 0.002 * normal(rng);
        if trap == Some(Reason::NoAction) {
            // The block is taken up, and put back.
            way = Vector3::new(rng.random_range(-0.02..0.02), rng.random_range(-0.02..0.02), 0.0);
        }
        let carried = carry(&mut plan, clock, way, scene.lift, &manner, rng);
        clock = carried.put_down + rng.random_range(0.2..0.5);
        plan.gripper_changes.push(clock);
        if trap == Some(Reason::SeveralActions) {
            // It stands badly, and is taken elsewhere.
            clock += rng.random_range(0.5..1.2);
            plan.gripper_changes.push(clock);
            let angle = rng.random_range(0.0..std::f64::consts::TAU);
            let length = rng.random_range(0.13..0.18);
            let elsewhere = Vector3::new(length * angle.cos(), length * angle.sin(), -way.z);
            plan.way = angle;
            let again = carry(&mut plan, clock, elsewhere, scene.lift, &manner, rng);
            clock = again.put_down + rng.random_range(0.2..0.5);
            plan.gripper_changes.push(clock);
        }
        plan.accident_secs = match trap {
            // The recording ends on the way.
            Some(Reason::Incomplete) => {
                rng.random_range(carried.lifted..carried.put_down.max(carried.lifted + 0.1))
            }
            Some(Reason::TooShort) => rng.random_range(0.4..2.5),
            _ => rng.random_range(0.1..0.9) * clock,
        };
        clock += rng.random_range(0.2..0.5);
        plan.retreat(clock, &scene.approach(), rng);
        Self { plan }
    }

    /// What the demonstration holds, read off the plan every millisecond.
    pub(super) fn truth(&self, truth: &mut Truth) {
        const STEP_SECS: f64 = 1e-3;
        let plan = &self.plan;
        let [grasped, released] = [plan.gripper_changes[0], plan.gripper_changes[1]];
        let at = |t: f64| plan.pose(t).translation.vector;
        let (source, place) = (at(grasped), at(released));
        let (mut left, mut arrived) = (f64::NAN, f64::NAN);
        let (mut height, mut samples) = (0.0, 0_u32);
        let steps = ((released - grasped) / STEP_SECS) as usize;
        for t in (0..=steps).map(|i| grasped + i as f64 * STEP_SECS) {
            let here = at(t);
            if left.is_nan() && (here - source).xy().norm() > AWAY_M {
                left = t;
            }
            if (here - place).xy().norm() > AWAY_M {
                arrived = t;
            }
        }
        for t in (0..=steps).map(|i| grasped + i as f64 * STEP_SECS) {
            if (left..arrived).contains(&t) {
                height += at(t).z - source.z;
                samples += 1;
            }
        }
        truth.task.insert("stack_location".into(), [place.x, place.y]);
        truth.task.insert("source_block".into(), [source.x, source.y]);
        for (name, value) in [
            ("grasp", grasped),
            ("stack_start", left - grasped),
            ("stack_end", arrived - grasped),
            ("stack_duration", arrived - left),
            ("duration", released - grasped),
            ("lift", height / f64::from(samples)),
        ] {
            truth.factors.insert(name.into(), value);
        }
    }
}

/// When parts of a way are over.
struct Carried {
    lifted: f64,
    put_down: f64,
}

/// Lifts a block, carries it over its place, and puts it down there from above.
fn carry(
    plan: &mut Plan,
    start: f64,
    way: Vector3<f64>,
    lift: f64,
    manner: &Manner,
    rng: &mut ChaCha8Rng,
) -> Carried {
    let lift_start = start + manner.pause;
    let up = plan.lift(lift_start, manner.lift_secs, lift, rng);
    let lifted = lift_start + manner.lift_secs;
    let carry_start = lift_start + manner.lift_secs * rng.random_range(0.5..0.8);
    let over = Vector3::new(way.x - up.x, way.y - up.y, 0.0);
    plan.carry(carry_start, manner.carry_secs, over, manner.yaw, rng);
    let carry_end = carry_start + manner.carry_secs;
    let down_start = carry_end - manner.carry_secs * rng.random_range(0.0..0.2);
    let duration = manner.down_secs;
    let down = Vector3::z() * (way.z - up.z);
    plan.moves.push(Move { start: down_start, duration, by: down });
    Carried { lifted, put_down: carry_end.max(down_start + duration) }
}

/// How the person stacks.
struct Manner {
    /// From the grasp to the lift, s.
    pause: f64,
    lift_secs: f64,
    carry_secs: f64,
    down_secs: f64,
    /// Turn of the hand about the vertical while carrying, rad.
    yaw: f64,
}

impl Manner {
    fn draw(simulation: &Simulation, scene: &Scene, rng: &mut ChaCha8Rng) -> Self {
        let tied = simulation.correlation * 0.6;
        let far = tied * scene.far + (1.0 - tied * tied).sqrt() * normal(rng);
        Self {
            pause: rng.random_range(0.3..1.5),
            lift_secs: rng.random_range(1.0..2.0),
            carry_secs: (2.8 * (0.25 * far).exp()).clamp(1.6, 4.8),
            down_secs: rng.random_range(1.1..2.0),
            yaw: (6.0 * normal(rng)).clamp(-14.0, 14.0).to_radians(),
        }
    }
}
