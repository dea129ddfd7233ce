//! People who pour from a cup.

use nalgebra::{Isometry3, UnitQuaternion, UnitVector3, Vector3};
use rand::RngExt;
use rand::rngs::ChaCha8Rng;

use super::plan::{Move, Plan, minimum_jerk_inverse};
use super::scene::Scene;
use super::{Simulation, Truth, normal};
use crate::demonstrations::recording::{Reason, Workplace};

/// Degrees above which the cup pours, and below which a demonstration ends.
const POUR_TILT_DEG: f64 = 70.0;
const END_TILT_DEG: f64 = 20.0;

/// One demonstration of pouring as it is meant.
pub(super) struct Pour {
    pub(super) plan: Plan,
    /// See [`Manner::from_right_deg`].
    from_right_deg: f64,
}

impl Pour {
    pub(super) fn draw(
        simulation: &Simulation,
        trap: Option<Reason>,
        workplace: &Workplace,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let scene = Scene::draw(simulation.correlation, trap, workplace, rng);
        let manner = Manner::draw(simulation, trap, &scene, rng);
        let mut clock = rng.random_range(0.4..1.4);
        let (mut plan, [behind, far]) = Plan::behind(&scene, rng);
        plan.tilt_axis = manner.tilt_axis;
        plan.drawn_back = manner.drawn_back;
        if rng.random_bool(0.12) {
            // Turning the open gripper over before the grasp is no pour.
            let duration = rng.random_range(2.6..3.6);
            let by = rng.random_range(80.0..100.0);
            plan.tilt_detours.push(Move { start: clock, duration, by });
            clock += duration + 0.1;
        }
        clock = plan.reach(clock, behind, -far, rng);
        clock += rng.random_range(0.25..0.6);
        let grasped = clock;
        plan.gripper_changes.push(grasped);

        // Lift and carry. The pour's start was drawn; lifting and carrying have to fit before it.
        let pause = manner.pause;
        let lift_start = grasped + pause;
        let time_to_pour = manner.pour_start - pause;
        let lift_secs = time_to_pour * rng.random_range(0.30..0.42);
        let up = plan.lift(lift_start, lift_secs, scene.lift, rng);
        let carry_start = lift_start + lift_secs * rng.random_range(0.45..0.75);
        // Carrying ends about when pouring begins, often a little later.
        let carry_end = grasped + manner.pour_start - rng.random_range(-0.5..1.0);
        let carry_secs = (carry_end - carry_start).max(1.0);
        let to_pour = scene.target - scene.grasp.translation.vector - up - manner.drawn_back;
        plan.carry(carry_start, carry_secs, to_pour, manner.yaw, rng);

        // The pour.
        let poured = pour(&mut plan, grasped + manner.pour_start, &manner, rng);
        let mut fallen = poured;
        if trap == Some(Reason::SeveralActions) {
            fallen = pour_again(&mut plan, poured, &manner, rng);
        }
        plan.accident_secs = match trap {
            // While it still pours, or on the way back up.
            Some(Reason::Incomplete) => {
                let end = plan.tilts.last().map_or(poured, |fall| fall.start);
                end + rng.random_range(-0.3..0.3)
            }
            Some(Reason::TooShort) => rng.random_range(0.4..2.5),
            _ => rng.random_range(0.1..0.9) * fallen,
        };
        if trap == Some(Reason::Incomplete) && rng.random_bool(0.5) {
            plan.gripper_changes.push(plan.accident_secs);
        }

        // Put the cup back, somewhere near its place.
        let back_start = fallen - rng.random_range(0.2..0.9);
        let place = Vector3::new(
            rng.random_range(-0.05..0.05),
            rng.random_range(-0.05..0.05),
            rng.random_range(0.0..0.01),
        );
        let here = plan.offset(1e9);
        let above = Vector3::new(place.x, place.y, here.z);
        let back_secs = rng.random_range(1.8..2.8);
        plan.moves.push(Move { start: back_start, duration: back_secs, by: above - here });
        plan.yaws.push(Move { start: back_start, duration: back_secs, by: -manner.yaw });
        let tilt_left = plan.tilt_deg(1e9);
        plan.tilts.push(Move { start: fallen, duration: 1.0, by: -tilt_left });
        let down_start = back_start + 0.7 * back_secs;
        let down_secs = rng.random_range(1.0..1.6);
        plan.moves.push(Move { start: down_start, duration: down_secs, by: place - above });
        clock = down_start.max(back_start + 0.3 * back_secs) + down_secs;
        clock = clock.max(back_start + back_secs) + rng.random_range(0.2..0.5);
        if plan.gripper_changes.len() % 2 == 1 {
            plan.gripper_changes.push(clock);
        }
        clock += rng.random_range(0.2..0.5);
        plan.retreat(clock, &scene.approach(), rng);
        Self { plan, from_right_deg: manner.from_right_deg }
    }

    /// What the demonstration holds, read off the plan every millisecond.
    pub(super) fn truth(&self, truth: &mut Truth) {
        const STEP_SECS: f64 = 1e-3;
        let plan = &self.plan;
        let grasped = plan.gripper_changes[0];
        let (mut sum, mut samples) = (Vector3::zeros(), 0_u32);
        let (mut first, mut last, mut maximum) = (f64::NAN, f64::NAN, 0.0_f64);
        let mut t = grasped;
        while t < plan.duration {
            let tilt = plan.tilt_deg(t);
            maximum = maximum.max(tilt);
            if tilt > POUR_TILT_DEG {
                if samples == 0 {
                    first = t;
                }
                last = t;
                sum += plan.pose(t).translation.vector;
                samples += 1;
            } else if samples > 0 && tilt < END_TILT_DEG {
                break;
            }
            t += STEP_SECS;
        }
        let mean = sum / f64::from(samples);
        let Isometry3 { translation, rotation } = plan.pose(grasped);
        let source = translation.vector;
        let from_right = self.from_right_deg;
        let to_the_right = is_to_the_right(&(mean - source), &rotation);
        let style = if to_the_right { from_right } else { 180.0 - from_right };
        truth.task.insert("pour_location".into(), [mean.x, mean.y]);
        truth.task.insert("source_cup".into(), [source.x, source.y]);
        for (name, value) in [
            ("grasp", grasped),
            ("pour_start", first - grasped),
            ("pour_end", last - grasped),
            ("pour_duration", f64::from(samples) * STEP_SECS),
            ("maximum_tilt", maximum),
            ("duration", t - grasped),
            ("lift", mean.z - source.z),
            ("style", style),
        ] {
            truth.factors.insert(name.into(), value);
        }
    }
}

/// Tilts and lets the tilt fall so that the cup pours from `start` for the manner's time;
/// returns when the tilt has fallen.
fn pour(plan: &mut Plan, start: f64, manner: &Manner, rng: &mut ChaCha8Rng) -> f64 {
    let from = plan.tilt_deg(1e9);
    let rise = Move {
        start: start - manner.rise_secs * manner.crossing(from),
        duration: manner.rise_secs,
        by: manner.maximum_tilt - from,
    };
    let left = rng.random_range(0.0..8.0_f64);
    let falls_by = manner.maximum_tilt - left;
    let until_crossing =
        minimum_jerk_inverse((manner.maximum_tilt - POUR_TILT_DEG).max(0.0) / falls_by);
    let fall = Move {
        start: start + manner.pour_duration - manner.fall_secs * until_crossing,
        duration: manner.fall_secs,
        by: -falls_by,
    };
    // Nobody holds an angle: it wavers by a degree.
    for _ in 0..2 {
        let duration = rng.random_range(0.5..1.0) * (fall.end() - rise.start) * 0.5;
        let start = rise.start + rng.random_range(0.2..1.0) * (fall.start - rise.start);
        plan.tilt_detours.push(Move { start, duration, by: rng.random_range(-1.2..1.2) });
    }
    // The hand moves while it pours, most often onward from where it came.
    let turn = plan.way + manner.stray;
    let length = rng.random_range(0.012..0.06);
    let along = Vector3::new(turn.cos(), turn.sin(), rng.random_range(-0.4..0.4));
    plan.moves.push(Move {
        start: start - rng.random_range(0.0..0.3),
        duration: manner.pour_duration.max(0.8) + rng.random_range(0.0..0.5),
        by: along * length,
    });
    plan.tilts.extend([rise, fall]);
    fall.end()
}

/// A second pour after the first: from a tilt that is left, after a pause elsewhere, or after
/// putting the gripper off and on. Returns when its tilt has fallen.
fn pour_again(plan: &mut Plan, poured: f64, manner: &Manner, rng: &mut ChaCha8Rng) -> f64 {
    match rng.random_range(0..3) {
        0 => {
            // The first fall stops half-way.
            let from = plan.tilt_deg(1e9);
            if let Some(fall) = plan.tilts.last_mut() {
                fall.by += rng.random_range(15.0..38.0) - from;
            }
        }
        1 => {
            let by =
                Vector3::new(rng.random_range(-0.06..0.06), rng.random_range(-0.06..0.06), 0.0);
            plan.moves.push(Move { start: poured, duration: 1.5, by });
        }
        _ => {
            let open = poured + rng.random_range(0.3..0.6);
            plan.gripper_changes.extend([open, open + rng.random_range(0.6..1.0)]);
        }
    }
    // Each grasp has its own cup axis; what tilt is left counts for the second one.
    let pause = rng.random_range(1.4..2.4) + manner.rise_secs * manner.crossing(0.0);
    pour(plan, poured + pause, manner, rng)
}

/// How the person pours.
struct Manner {
    /// From the grasp to the lift, s.
    pause: f64,
    /// From the grasp to the pour, s.
    pour_start: f64,
    pour_duration: f64,
    maximum_tilt: f64,
    rise_secs: f64,
    fall_secs: f64,
    /// What the cup is tilted about, as an angle from the hand's direction: 0 degrees where it rolls to
    /// the hand's right, 90 where it pitches ahead, 180 where it rolls to the left.
    from_right_deg: f64,
    tilt_axis: UnitVector3<f64>,
    /// Where the hand draws back to while the cup tilts, so that the spout stays over the bowl.
    drawn_back: Vector3<f64>,
    /// Direction of the hand's motion while it pours, from that of the way before it, rad.
    stray: f64,
    /// Turn of the hand about the vertical while carrying, rad.
    yaw: f64,
}

impl Manner {
    fn draw(
        simulation: &Simulation,
        trap: Option<Reason>,
        scene: &Scene,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let Simulation { correlation, both_sides, .. } = *simulation;
        let tied = correlation * 0.6;
        let from_roll = match rng.random_range(0.0..1.0) {
            u if u < 0.6 => rng.random_range(0.0..12.0),
            u if u < 0.9 => rng.random_range(20.0..50.0),
            _ => rng.random_range(65.0..90.0_f64),
        };
        let hand = scene.grasp.rotation;
        let (roll, pitch) = (hand * Vector3::z(), -(hand * Vector3::y()));
        // People mostly lean a cup to the side to which they carry it.
        let way = scene.target - scene.grasp.translation.vector;
        let to_the_right = match both_sides {
            true => is_to_the_right(&way, &hand) == rng.random_bool(0.5 + 0.5 * correlation),
            false => true,
        };
        let from_right_deg = if to_the_right { from_roll } else { 180.0 - from_roll };
        let from_right = from_right_deg.to_radians();
        let tilt_axis =
            UnitVector3::new_normalize(roll * from_right.cos() + pitch * from_right.sin());
        // The spout is some centimetres above the hand, and leans to where the tilt's axis says.
        let leans = tilt_axis.cross(&Vector3::z()).normalize();
        let drawn_back = -leans * rng.random_range(0.02..0.07);
        let stray = if correlation > 0.0 {
            0.9 * normal(rng)
        } else {
            rng.random_range(0.0..std::f64::consts::TAU)
        };
        let yaw = (6.0 * normal(rng)).clamp(-14.0, 14.0).to_radians();
        loop {
            let z = normal(rng);
            let other = normal(rng);
            let mut maximum_tilt = 90.0 + 8.0 * z;
            let spread = correlation * z + (1.0 - correlation * correlation).sqrt() * other;
            let pour_duration = 2.5 * (0.35 * spread).exp();
            let late = tied * scene.far + (1.0 - tied * tied).sqrt() * normal(rng);
            let pour_start = 4.3 + 0.8 * late;
            let mut rise_secs = (4.5 + 0.9 * normal(rng)).clamp(3.0, 6.0);
            let mut fall_secs = rng.random_range(2.5..3.7);
            let pause = rng.random_range(0.3..0.9);
            if !(74.0..115.0).contains(&maximum_tilt)
                || !(1.2..6.0).contains(&pour_duration)
                || !(2.8..7.0).contains(&pour_start)
            {
                continue;
            }
            if trap == Some(Reason::NoAction) {
                maximum_tilt = rng.random_range(35.0..64.0);
            }
            // The tilt begins after the lift; a short pour has fast ramps.
            let crossing = minimum_jerk_inverse((POUR_TILT_DEG / maximum_tilt).min(1.0));
            rise_secs = rise_secs.min((pour_start - pause - 0.2) / crossing);
            let faster = ((pour_duration - 0.05) / ((1.0 - crossing) * (rise_secs + fall_secs)))
                .clamp(0.0, 1.0);
            if trap != Some(Reason::NoAction) {
                rise_secs *= faster;
                fall_secs *= faster;
            }
            if rise_secs < 1.4 || fall_secs < 1.2 {
                continue;
            }
            return Self {
                pause,
                pour_start,
                pour_duration,
                maximum_tilt,
                rise_secs,
                fall_secs,
                from_right_deg,
                tilt_axis,
                drawn_back,
                stray,
                yaw,
            };
        }
    }

    /// The share of the rise's time, from a tilt that is left, after which the cup pours.
    fn crossing(&self, from: f64) -> f64 {
        minimum_jerk_inverse(((POUR_TILT_DEG - from) / (self.maximum_tilt - from)).min(1.0))
    }
}

/// Whether a way over the ground goes to the right of where the hand points.
fn is_to_the_right(way: &Vector3<f64>, hand: &UnitQuaternion<f64>) -> bool {
    way.dot(&(hand * Vector3::z()).cross(&Vector3::z())) > 0.0
}
