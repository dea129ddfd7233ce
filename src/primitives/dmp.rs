//! Dynamic movement primitives (A. J. Ijspeert, J. Nakanishi, H. Hoffmann, P. Pastor and S. Schaal,
//! *Dynamical Movement Primitives: Learning Attractor Models for Motor Behaviors*, 2013).
//!
//! A damped spring pulls the state y to the goal g, and a forcing term f shapes the way there:
//!
//! `y'' = alpha (beta (g - y) - y' - beta (g - y_0) z) + f(z)`, `f(z) = z sum_i v_i psi_i(z)`,
//!
//! where `z = exp(-alpha_z s)` falls from 1 to [`FINAL_PHASE`] while the phase s runs from 0 to 1.
//! The term with z is that of P. Pastor et al. (*Learning and Generalization of Motor Skills by
//! Learning from Demonstration*, 2009), [`DmpConfig::smooth_scaling`]: without it a new goal starts
//! the motion with a jerk. The forcing term is not scaled by `g - y_0`, so a motion that returns to
//! its start is no special case. Orientations go by A. Ude et al. (*Orientation in Cartesian Space
//! Dynamic Movement Primitives*, 2014): differences are rotation vectors in the world.
//!
//! Everything is in phase, so a motion's duration scales its time and nothing else: it is that of
//! the [`Motion`] that the states are played in.
//!
//! Functions, constants and integration are those of dfki-ric/movement_primitives.
//!
//! [`Motion`]: crate::trajectory::Motion

use nalgebra::{Cholesky, DMatrix, DVector, Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;
use serde::{Deserialize, Serialize};

use super::{
    MOST_FUNCTIONS, PrimitiveError, STEPS, bounded, check, check_window, generated, prepared,
    wrong_numbers, wrong_sizes,
};
use crate::parameters::{TaskParameters, TaskSpace};
use crate::primitive::{Demonstration, Generated, MovementPrimitive};
use crate::trajectory::Trajectory;

/// What z has fallen to at the end of the motion.
pub const FINAL_PHASE: f64 = 0.01;
/// Value of a basis function at its neighbour's centre.
const OVERLAP: f64 = 0.8;
/// Stiffness of the spring.
const ALPHA: f64 = 25.0;
/// With this factor the spring is critically damped.
const BETA: f64 = ALPHA / 4.0;
/// Longest step of the integration, in phase.
const LONGEST_STEP: f64 = 1e-3;

/// How a dynamic movement primitive is fitted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DmpConfig {
    /// States of a generated trajectory; demonstrations are resampled to them. Only
    /// [`DmpPrimitive`] asks.
    pub steps: usize,
    /// Basis functions of the forcing term.
    pub basis_functions: usize,
    /// Ridge of the regression of the weights.
    pub ridge: f64,
    /// Whether the spring's pull towards a new goal grows with time instead of starting at once. A
    /// motion then starts gently whatever its goal, but follows a new goal late: 2.5 % of the
    /// difference are missing at the end, and more before it, where pours happen.
    pub smooth_scaling: bool,
    /// Share of the motion by which dynamic time warping may move its steps, to give the
    /// demonstrations the timing of the most typical one first; with 0 they keep their own. Only [`DmpPrimitive`] asks.
    pub alignment_window: f64,
}

impl Default for DmpConfig {
    fn default() -> Self {
        Self {
            steps: STEPS,
            basis_functions: 30,
            ridge: 1e-9,
            smooth_scaling: false,
            alignment_window: 0.0,
        }
    }
}

impl DmpConfig {
    fn check(&self) -> Result<(), PrimitiveError> {
        let Self { steps: _, basis_functions, ridge, smooth_scaling: _, alignment_window } = *self;
        check_window(alignment_window)?;
        let error = |name, value, range| Err(PrimitiveError::Setting { name, value, range });
        if !(2..=MOST_FUNCTIONS).contains(&basis_functions) {
            return error("basis_functions", basis_functions as f64, "from 2 to 1000");
        }
        if !(0.0..=1e6).contains(&ridge) {
            return error("ridge", ridge, "from 0 to 1e6");
        }
        Ok(())
    }
}

/// `z` at phase `s`.
fn z(s: f64) -> f64 {
    (FINAL_PHASE.ln() * s).exp()
}

/// The functions that the forcing term multiplies its weights with: `z psi(z)`, where the psi are
/// Gaussians of z that sum to 1, with centres at equal steps of phase.
struct Basis {
    centers: Vec<f64>,
    widths: Vec<f64>,
}

impl Basis {
    /// # Panics
    /// With fewer than two functions.
    fn new(count: usize) -> Self {
        let centers: Vec<f64> = (0..count).map(|i| z(i as f64 / (count - 1) as f64)).collect();
        // The last one's neighbour is the one before it.
        let width = |i: usize| {
            let i = i.min(count - 2);
            -OVERLAP.ln() / (centers[i + 1] - centers[i]).powi(2)
        };
        let widths = (0..count).map(width).collect();
        Self { centers, widths }
    }

    fn at(&self, z: f64) -> DVector<f64> {
        let functions = self.centers.iter().zip(&self.widths);
        let values = functions.map(|(center, width)| (-width * (z - center).powi(2)).exp());
        let values = DVector::from_iterator(self.centers.len(), values);
        let scale = z / values.sum();
        values * scale
    }
}

/// The weights `[dim, basis_functions]` whose forcing term comes nearest to `forces`, one column
/// for each of the equal steps of phase.
fn fit_forces(config: &DmpConfig, forces: &DMatrix<f64>) -> Result<DMatrix<f64>, PrimitiveError> {
    config.check()?;
    let last = (forces.ncols() - 1) as f64;
    let basis = Basis::new(config.basis_functions);
    let columns: Vec<_> = (0..forces.ncols()).map(|t| basis.at(z(t as f64 / last))).collect();
    let design = DMatrix::from_columns(&columns);
    let mut normal = &design * design.transpose();
    for i in 0..config.basis_functions {
        normal[(i, i)] += config.ridge;
    }
    let matrix = "matrix of the basis functions";
    let cholesky =
        Cholesky::new(normal).ok_or(PrimitiveError::NotPositiveDefinite { matrix, index: 0 })?;
    Ok(cholesky.solve(&(design * forces.transpose())).transpose())
}

/// The change of `columns` per unit of phase: central differences, one-sided at both ends.
fn gradient(columns: &DMatrix<f64>) -> DMatrix<f64> {
    let last = columns.ncols() - 1;
    let slope = |t: usize| {
        let (before, after) = (t.saturating_sub(1), (t + 1).min(last));
        let difference = columns.column(after) - columns.column(before);
        difference * (last as f64 / (after - before) as f64)
    };
    DMatrix::from_columns(&(0..=last).map(slope).collect::<Vec<_>>())
}

/// The forces that make a motion: `velocities` and `to_goal`, the differences from each state to the
/// goal, are columns. The motion ends at rest.
fn forces(
    config: &DmpConfig,
    mut velocities: DMatrix<f64>,
    to_goal: &DMatrix<f64>,
) -> DMatrix<f64> {
    let last = velocities.ncols() - 1;
    velocities.column_mut(last).fill(0.0);
    let mut accelerations = gradient(&velocities);
    accelerations.column_mut(last).fill(0.0);
    let mut forces = accelerations + ALPHA * velocities - ALPHA * BETA * to_goal;
    if config.smooth_scaling {
        for (t, mut column) in forces.column_iter_mut().enumerate() {
            column.axpy(ALPHA * BETA * z(t as f64 / last as f64), &to_goal.column(0), 1.0);
        }
    }
    forces
}

/// Integrates from rest to phase 1 in `steps` states (semi-implicit Euler). `difference` is that
/// from a state to the goal, `advance` moves a state by a displacement.
fn integrate<S: Clone>(
    weights: &DMatrix<f64>,
    smooth_scaling: bool,
    steps: usize,
    start: S,
    difference: impl Fn(&S) -> DVector<f64>,
    advance: impl Fn(&S, DVector<f64>) -> S,
) -> Vec<S> {
    assert!(steps >= 2, "a trajectory has at least 2 steps");
    let per_step = (1.0 / ((steps - 1) as f64 * LONGEST_STEP) - 1e-9).ceil().max(1.0) as usize;
    let substeps = (steps - 1) * per_step;
    let ds = 1.0 / substeps as f64;
    let basis = Basis::new(weights.ncols());
    let from_start = difference(&start);
    let mut velocity = DVector::zeros(from_start.len());
    let mut state = start;
    let mut states = Vec::with_capacity(steps);
    states.push(state.clone());
    for substep in 1..=substeps {
        let z = z(substep as f64 * ds);
        let mut pull = difference(&state);
        if smooth_scaling {
            pull.axpy(-z, &from_start, 1.0);
        }
        let mut acceleration = weights * basis.at(z);
        acceleration.axpy(ALPHA * BETA, &pull, 1.0);
        acceleration.axpy(-ALPHA, &velocity, 1.0);
        velocity.axpy(ds, &acceleration, 1.0);
        state = advance(&state, &velocity * ds);
        if substep % per_step == 0 {
            states.push(state.clone());
        }
    }
    states
}

/// `weights`, each times `1 + share * e` with standard normal `e`: another motion of the same kind,
/// from the same start to the same goal, pushed by forces that are a little larger or smaller.
///
/// # Panics
/// When `share` is negative or not finite.
pub fn perturbed<R: Rng + ?Sized>(weights: &DMatrix<f64>, share: f64, rng: &mut R) -> DMatrix<f64> {
    assert!((0.0..f64::INFINITY).contains(&share), "a share of the weights");
    weights.map(|v| v * (1.0 + share * rng.sample::<f64, _>(StandardNormal)))
}

/// A dynamic movement primitive of a vector: a position, or any state whose values may be added.
#[derive(Debug, Clone, PartialEq)]
pub struct Dmp {
    /// Weights of the forcing term, `[dim, basis_functions]`.
    pub weights: DMatrix<f64>,
    /// First state of the demonstration, `[dim]`.
    pub start: DVector<f64>,
    /// Last state of the demonstration, `[dim]`.
    pub goal: DVector<f64>,
    /// As it was fitted, see [`DmpConfig::smooth_scaling`].
    pub smooth_scaling: bool,
}

impl Dmp {
    /// Fits the primitive to a motion.
    ///
    /// # Errors
    /// Settings out of range; more basis functions than the motion determines, without a ridge.
    pub fn fit(config: &DmpConfig, motion: &Trajectory) -> Result<Self, PrimitiveError> {
        let states = DMatrix::from_column_slice(motion.dim(), motion.steps(), motion.values());
        let [start, goal] = [0, motion.steps() - 1].map(|t| states.column(t).into_owned());
        let mut to_goal = -states.clone();
        to_goal.column_iter_mut().for_each(|mut column| column += &goal);
        let forces = forces(config, gradient(&states), &to_goal);
        let weights = fit_forces(config, &forces)?;
        Ok(Self { weights, start, goal, smooth_scaling: config.smooth_scaling })
    }

    /// The motion from `start` to `goal` in `steps` states.
    ///
    /// # Panics
    /// When `start` or `goal` are not `[dim]` finite values, or `steps` is below 2.
    pub fn rollout(&self, start: &DVector<f64>, goal: &DVector<f64>, steps: usize) -> Trajectory {
        let dim = self.weights.nrows();
        assert!(start.len() == dim && goal.len() == dim, "start and goal are states");
        let difference = |state: &DVector<f64>| goal - state;
        let advance = |state: &DVector<f64>, by| state + by;
        let states = integrate(
            &self.weights,
            self.smooth_scaling,
            steps,
            start.clone(),
            difference,
            advance,
        );
        let values = states.iter().flat_map(|s| s.iter().copied()).collect();
        Trajectory::new(dim, values).expect("finite weights, start and goal")
    }
}

/// A dynamic movement primitive of an orientation.
///
/// The way to the goal is the shorter one, so a motion may not leave its goal by more than half a
/// turn.
#[derive(Debug, Clone, PartialEq)]
pub struct OrientationDmp {
    /// Weights of the forcing term, `[3, basis_functions]`.
    pub weights: DMatrix<f64>,
    /// First orientation of the demonstration.
    pub start: UnitQuaternion<f64>,
    /// Last orientation of the demonstration.
    pub goal: UnitQuaternion<f64>,
    /// As it was fitted, see [`DmpConfig::smooth_scaling`].
    pub smooth_scaling: bool,
}

impl OrientationDmp {
    /// Fits the primitive to orientations at equal steps of phase.
    ///
    /// # Errors
    /// Settings out of range; fewer than 2 orientations; more basis functions than they determine,
    /// without a ridge.
    pub fn fit(
        config: &DmpConfig,
        orientations: &[UnitQuaternion<f64>],
    ) -> Result<Self, PrimitiveError> {
        let &[start, .., goal] = orientations else {
            let (what, found, needed) = ("orientations", orientations.len(), 2);
            return Err(PrimitiveError::TooFew { what, found, needed, remedy: "add some" });
        };
        let last = orientations.len() - 1;
        let between = |from: &UnitQuaternion<f64>, to: &UnitQuaternion<f64>| {
            DVector::from_column_slice((to * from.inverse()).scaled_axis().as_slice())
        };
        let slope = |t: usize| {
            let (before, after) = (t.saturating_sub(1), (t + 1).min(last));
            between(&orientations[before], &orientations[after])
                * (last as f64 / (after - before) as f64)
        };
        let velocities = DMatrix::from_columns(&(0..=last).map(slope).collect::<Vec<_>>());
        let to_goal: Vec<_> = orientations.iter().map(|q| between(q, &goal)).collect();
        let forces = forces(config, velocities, &DMatrix::from_columns(&to_goal));
        let weights = fit_forces(config, &forces)?;
        Ok(Self { weights, start, goal, smooth_scaling: config.smooth_scaling })
    }

    /// The orientations from `start` to `goal` in `steps` steps.
    ///
    /// # Panics
    /// When `steps` is below 2.
    pub fn rollout(
        &self,
        start: &UnitQuaternion<f64>,
        goal: &UnitQuaternion<f64>,
        steps: usize,
    ) -> Vec<UnitQuaternion<f64>> {
        let difference = |q: &UnitQuaternion<f64>| {
            DVector::from_column_slice((goal * q.inverse()).scaled_axis().as_slice())
        };
        let advance = |q: &UnitQuaternion<f64>, by: DVector<f64>| {
            UnitQuaternion::from_scaled_axis(Vector3::new(by[0], by[1], by[2])) * q
        };
        integrate(&self.weights, self.smooth_scaling, steps, *start, difference, advance)
    }
}

/// A dynamic movement primitive of a pose: one of the position and one of the orientation, beside
/// each other.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseDmp {
    /// Of the position.
    pub position: Dmp,
    /// Of the orientation.
    pub orientation: OrientationDmp,
}

impl PoseDmp {
    /// Fits the primitive to poses at equal steps of phase.
    ///
    /// # Errors
    /// As [`OrientationDmp::fit`].
    pub fn fit(config: &DmpConfig, poses: &[Isometry3<f64>]) -> Result<Self, PrimitiveError> {
        let rotations: Vec<_> = poses.iter().map(|pose| pose.rotation).collect();
        let orientation = OrientationDmp::fit(config, &rotations)?;
        let positions = poses.iter().flat_map(|pose| pose.translation.vector.data.0[0]).collect();
        let positions = Trajectory::new(3, positions).expect("finite poses, at least two");
        Ok(Self { position: Dmp::fit(config, &positions)?, orientation })
    }

    /// First pose of the demonstration.
    pub fn start(&self) -> Isometry3<f64> {
        pose(self.position.start.as_slice(), self.orientation.start)
    }

    /// Last pose of the demonstration.
    pub fn goal(&self) -> Isometry3<f64> {
        pose(self.position.goal.as_slice(), self.orientation.goal)
    }

    /// The poses from `start` to `goal` in `steps` steps.
    ///
    /// # Panics
    /// When a pose is not finite, or `steps` is below 2.
    pub fn rollout(
        &self,
        start: &Isometry3<f64>,
        goal: &Isometry3<f64>,
        steps: usize,
    ) -> Vec<Isometry3<f64>> {
        let [from, to] = [start, goal]
            .map(|pose| DVector::from_column_slice(pose.translation.vector.as_slice()));
        let positions = self.position.rollout(&from, &to, steps);
        let orientations = self.orientation.rollout(&start.rotation, &goal.rotation, steps);
        positions.states().zip(orientations).map(|(p, q)| pose(p, q)).collect()
    }

    /// Another motion of the same kind, see [`perturbed`].
    ///
    /// # Panics
    /// When `share` is negative or not finite.
    #[must_use]
    pub fn perturbed<R: Rng + ?Sized>(&self, share: f64, rng: &mut R) -> Self {
        let mut other = self.clone();
        other.position.weights = perturbed(&self.position.weights, share, rng);
        other.orientation.weights = perturbed(&self.orientation.weights, share, rng);
        other
    }
}

fn pose(position: &[f64], rotation: UnitQuaternion<f64>) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::new(position[0], position[1], position[2]), rotation)
}

/// One end of the motion, as the task moves it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct End {
    /// The location that the first two values are measured from; the world where none.
    location: Option<usize>,
    /// Mean of the demonstrations' states, measured so.
    state: DVector<f64>,
}

impl End {
    /// The mean of `states`, one for each demonstration, measured from that location from which
    /// they differ least.
    fn of(states: &[DVector<f64>], demonstrations: &[Demonstration], space: &TaskSpace) -> Self {
        let measured = |location: Option<usize>| {
            let mut columns = DMatrix::from_columns(states);
            if let Some(location) = location {
                for (mut column, demonstration) in columns.column_iter_mut().zip(demonstrations) {
                    let [x, y] = demonstration.w.location(location);
                    column[0] -= x;
                    column[1] -= y;
                }
            }
            let mean = columns.column_mean();
            columns.column_iter_mut().for_each(|mut column| column -= &mean);
            (columns.norm(), Self { location, state: mean })
        };
        let locations = (0..space.locations().len()).map(Some);
        let ends = locations.chain([None]).map(measured);
        let best = ends.min_by(|a, b| a.0.total_cmp(&b.0));
        best.expect("the world is always there").1
    }

    fn at(&self, w: &TaskParameters) -> DVector<f64> {
        let mut state = self.state.clone();
        if let Some(location) = self.location {
            let [x, y] = w.location(location);
            state[0] += x;
            state[1] += y;
        }
        state
    }
}

/// The stored parts of a [`DmpPrimitive`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Parts {
    task_space: TaskSpace,
    steps: usize,
    smooth_scaling: bool,
    /// Mean over the demonstrations, `[state_dim, basis_functions]`.
    #[serde(with = "super::matrix")]
    weights: DMatrix<f64>,
    start: End,
    goal: End,
    /// Root mean square distance of the demonstrations from what is generated for their tasks,
    /// `[state_dim, steps]`.
    #[serde(with = "super::matrix")]
    deviation: DMatrix<f64>,
}

/// The dynamic movement primitive of a set of demonstrations, moved to the task.
///
/// One primitive is fitted to each demonstration, and their weights are averaged. Start and goal
/// follow the task: each is a mean offset from one of its locations, in x and y, whichever location
/// the demonstrations' ends keep the most constant distance from; the other values are means.
///
/// For pouring, whose motion goes from the grasp to where the cup is upright again beside the pour,
/// the start so follows the source and the goal the place of the pour. The pour itself is not the
/// goal: it lies on the way, at a time when the spring has made up for most, not all, of the
/// difference to a new goal, and a task's G shows how much is missing. Rotation vectors are taken as
/// values that may be added, as everywhere in states.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Parts", into = "Parts")]
pub struct DmpPrimitive {
    parts: Parts,
}

impl DmpPrimitive {
    /// Fits the primitive to demonstrations.
    ///
    /// # Errors
    /// No demonstrations, or some of another task space or state; settings out of range; more basis
    /// functions than the motions determine, without a ridge.
    pub fn fit(
        config: &DmpConfig,
        space: &TaskSpace,
        demonstrations: &[Demonstration],
    ) -> Result<Self, PrimitiveError> {
        let steps = config.steps;
        let state_dim = check(space, steps, demonstrations, 1)?;
        let motions = prepared(steps, config.alignment_window, demonstrations);
        let dmps = motions.iter().map(|m| Dmp::fit(config, m)).collect::<Result<Vec<_>, _>>()?;
        let mut weights = DMatrix::zeros(state_dim, config.basis_functions);
        dmps.iter().for_each(|dmp| weights += &dmp.weights / dmps.len() as f64);
        let end = |of: fn(&Dmp) -> &DVector<f64>| {
            let states: Vec<_> = dmps.iter().map(|dmp| of(dmp).clone()).collect();
            End::of(&states, demonstrations, space)
        };
        let (start, goal) = (end(|dmp| &dmp.start), end(|dmp| &dmp.goal));
        let mut parts = Parts {
            task_space: space.clone(),
            steps,
            smooth_scaling: config.smooth_scaling,
            weights,
            start,
            goal,
            deviation: DMatrix::zeros(state_dim, steps),
        };
        let undeviated = Self::try_from(parts.clone())?;
        for (motion, demonstration) in motions.iter().zip(demonstrations) {
            let mean = undeviated.rollout(&demonstration.w);
            let pairs = motion.values().iter().zip(mean.values());
            let squares = pairs.map(|(a, b)| (a - b).powi(2) / motions.len() as f64);
            parts.deviation.iter_mut().zip(squares).for_each(|(sum, square)| *sum += square);
        }
        parts.deviation.apply(|v| *v = v.sqrt());
        Self::try_from(parts)
    }

    /// The averaged primitive, with start and goal for task `w`.
    pub fn dmp(&self, w: &TaskParameters) -> Dmp {
        let Parts { smooth_scaling, weights, start, goal, .. } = &self.parts;
        Dmp {
            weights: weights.clone(),
            start: start.at(w),
            goal: goal.at(w),
            smooth_scaling: *smooth_scaling,
        }
    }

    fn rollout(&self, w: &TaskParameters) -> Trajectory {
        let dmp = self.dmp(w);
        dmp.rollout(&dmp.start, &dmp.goal, self.parts.steps)
    }
}

impl TryFrom<Parts> for DmpPrimitive {
    type Error = PrimitiveError;

    fn try_from(parts: Parts) -> Result<Self, PrimitiveError> {
        let Parts { task_space, steps, smooth_scaling: _, weights, start, goal, deviation } =
            &parts;
        let (state_dim, count) = weights.shape();
        let locations = task_space.locations().len();
        let numbers = [
            weights.as_slice(),
            start.state.as_slice(),
            goal.state.as_slice(),
            deviation.as_slice(),
        ];
        let follows = |end: &End| end.location.is_none_or(|l| l < locations);
        let wrong = if let Some(wrong) = wrong_sizes(task_space, *steps, state_dim) {
            Some(wrong)
        } else if !(2..=MOST_FUNCTIONS).contains(&count) {
            Some(format!("{count} weights for each value; 2 to {MOST_FUNCTIONS} are possible"))
        } else if start.state.len() != state_dim || goal.state.len() != state_dim {
            Some(format!("an end is not of {state_dim} values"))
        } else if deviation.shape() != (state_dim, *steps) {
            Some(format!("the deviation is not of {steps} steps of {state_dim} values"))
        } else if !follows(start) || !follows(goal) {
            Some(format!("an end follows a location that is none of the {locations}"))
        } else {
            wrong_numbers(numbers.into_iter().flatten())
        };
        match wrong {
            Some(detail) => Err(PrimitiveError::Parts { primitive: "DMP", detail }),
            None => Ok(Self { parts }),
        }
    }
}

impl From<DmpPrimitive> for Parts {
    fn from(primitive: DmpPrimitive) -> Self {
        primitive.parts
    }
}

impl MovementPrimitive for DmpPrimitive {
    fn task_space(&self) -> &TaskSpace {
        &self.parts.task_space
    }

    fn steps(&self) -> usize {
        self.parts.steps
    }

    fn state_dim(&self) -> usize {
        self.parts.weights.nrows()
    }

    fn generate(&self, w: &TaskParameters) -> Generated {
        let variances = self.parts.deviation.iter().map(|v| v * v).collect();
        let states = self.rollout(&bounded(self.task_space(), w));
        generated(self.state_dim(), states.values().to_vec(), variances)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::primitives::tests::{demonstrations, largest_difference, space, task};
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    fn demonstrated() -> Trajectory {
        demonstrations(2, 1)[0].motion.states.resampled(101)
    }

    #[test]
    fn a_rollout_repeats_the_demonstration_and_reaches_another_goal() {
        let motion = demonstrated();
        for smooth_scaling in [false, true] {
            let config = DmpConfig { smooth_scaling, ..DmpConfig::default() };
            let dmp = Dmp::fit(&config, &motion).unwrap();
            let repeated = dmp.rollout(&dmp.start, &dmp.goal, 101);
            let difference = largest_difference(&repeated, &motion);
            assert!(difference < 0.015, "{difference}");
            let goal = &dmp.goal + DVector::from_vec(vec![0.2, -0.1, 0.05]);
            let moved = dmp.rollout(&dmp.start, &goal, 101);
            let missed = (DVector::from_column_slice(moved.state(100)) - goal).norm();
            assert!(missed < 0.015, "{missed}");
            assert_eq!(moved.state(0), dmp.start.as_slice());
        }
    }

    #[test]
    fn moving_start_and_goal_moves_the_motion() {
        let dmp = Dmp::fit(&DmpConfig::default(), &demonstrated()).unwrap();
        let by = DVector::from_vec(vec![1.0, -2.0, 0.5]);
        let here = dmp.rollout(&dmp.start, &dmp.goal, 51);
        let there = dmp.rollout(&(&dmp.start + &by), &(&dmp.goal + &by), 51);
        for (a, b) in here.states().zip(there.states()) {
            for i in 0..3 {
                assert!((a[i] + by[i] - b[i]).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn an_orientation_is_repeated_and_turned_with_its_ends() {
        let turn = |s: f64| {
            let share = s * s * s * (10.0 + s * (6.0 * s - 15.0));
            UnitQuaternion::from_euler_angles(1.5 * share, 0.4 * share, 0.0)
        };
        let demonstrated: Vec<_> = (0..101).map(|t| turn(f64::from(t) / 100.0)).collect();
        let dmp = OrientationDmp::fit(&DmpConfig::default(), &demonstrated).unwrap();
        let repeated = dmp.rollout(&dmp.start, &dmp.goal, 101);
        for (a, b) in repeated.iter().zip(&demonstrated) {
            assert!(a.angle_to(b) < 0.01, "{}", a.angle_to(b));
        }
        let goal = UnitQuaternion::from_euler_angles(0.2, -0.3, 0.5) * dmp.goal;
        let other = dmp.rollout(&dmp.start, &goal, 101);
        assert!(other[100].angle_to(&goal) < 0.03, "{}", other[100].angle_to(&goal));
        assert!(OrientationDmp::fit(&DmpConfig::default(), &demonstrated[..1]).is_err());
    }

    #[test]
    fn a_pose_goes_where_its_position_and_its_orientation_go() {
        let share = |s: f64| s * s * s * (10.0 + s * (6.0 * s - 15.0));
        let poses: Vec<Isometry3<f64>> = (0..101)
            .map(|t| share(f64::from(t) / 100.0))
            .map(|s| {
                Isometry3::new(Vector3::new(s, -0.5 * s, 0.3), Vector3::new(0.0, 1.2 * s, 0.1))
            })
            .collect();
        let dmp = PoseDmp::fit(&DmpConfig::default(), &poses).unwrap();
        assert_eq!((dmp.start(), dmp.goal()), (poses[0], poses[100]));
        let apart = |a: &Isometry3<f64>, b: &Isometry3<f64>| {
            let distance = (a.translation.vector - b.translation.vector).norm();
            distance.max(a.rotation.angle_to(&b.rotation))
        };
        let repeated = dmp.rollout(&dmp.start(), &dmp.goal(), 101);
        assert!(repeated.iter().zip(&poses).all(|(a, b)| apart(a, b) < 0.01));
        let goal = Translation3::new(0.1, 0.2, -0.1)
            * poses[100]
            * Isometry3::rotation(0.3 * Vector3::x());
        let moved = dmp.rollout(&dmp.start(), &goal, 101);
        assert!(apart(&moved[100], &goal) < 0.005, "{}", apart(&moved[100], &goal));
        let other = dmp.perturbed(0.1, &mut ChaCha8Rng::seed_from_u64(1));
        let other = other.rollout(&dmp.start(), &dmp.goal(), 101);
        assert!(apart(&other[50], &repeated[50]) > 1e-4);
        assert!(apart(&other[100], &repeated[100]) < 0.01);
    }

    #[test]
    fn perturbed_weights_give_another_motion_between_the_same_ends() {
        let dmp = Dmp::fit(&DmpConfig::default(), &demonstrated()).unwrap();
        let motion = |weights| {
            let dmp = Dmp { weights, ..dmp.clone() };
            dmp.rollout(&dmp.start, &dmp.goal, 101)
        };
        let perturb =
            |share, seed| perturbed(&dmp.weights, share, &mut ChaCha8Rng::seed_from_u64(seed));
        assert_eq!(perturb(0.0, 1), dmp.weights);
        assert_eq!(perturb(0.1, 1), perturb(0.1, 1));
        let (before, after) = (motion(dmp.weights.clone()), motion(perturb(0.1, 1)));
        let difference = largest_difference(&before, &after);
        assert!((0.001..0.1).contains(&difference), "{difference}");
        assert_eq!(before.state(0), after.state(0));
        let ends = before.state(100).iter().zip(after.state(100)).map(|(a, b)| (a - b).abs());
        assert!(ends.fold(0.0, f64::max) < 0.01);
        // The noise has the size that it says.
        let spread = (perturb(0.1, 2) - &dmp.weights).norm() / dmp.weights.norm();
        assert!((spread / 0.1 - 1.0).abs() < 0.35, "{spread}");
    }

    #[test]
    fn the_ends_follow_the_locations_that_the_demonstrations_follow() {
        let demonstrations = demonstrations(2, 20);
        let config = DmpConfig { steps: 60, ..DmpConfig::default() };
        let primitive = DmpPrimitive::fit(&config, &space(2), &demonstrations).unwrap();
        assert_eq!(primitive.parts.start.location, Some(1));
        assert_eq!(primitive.parts.goal.location, Some(0));
        let here = primitive.generate(&task(&[0.3, 0.2, -0.4, 0.1]));
        let (first, last) = (here.mean.state(0), here.mean.state(59));
        assert!((first[0] + 0.4).hypot(first[1] - 0.1) < 1e-3, "{first:?}");
        // 2.5 % of the way is not made up for by the end.
        assert!((last[0] - 0.3).hypot(last[1] - 0.2) < 0.03, "{last:?}");
        let there = primitive.generate(&task(&[1.3, -1.8, 0.6, -1.9]));
        for (a, b) in here.mean.states().zip(there.mean.states()) {
            assert!((a[0] + 1.0 - b[0]).abs() < 1e-9 && (a[1] - 2.0 - b[1]).abs() < 1e-9);
        }
        assert_eq!(here.stddev, there.stddev);
    }

    #[test]
    fn what_never_moves_with_the_task_stays_in_the_world() {
        let still = DVector::from_vec(vec![0.25, 0.125, 0.0]);
        let demonstrations = demonstrations(2, 4);
        let states = vec![still.clone(); 4];
        assert_eq!(
            End::of(&states, &demonstrations, &space(2)),
            End { location: None, state: still }
        );
    }

    #[test]
    fn storing_gives_the_same_primitive_and_odd_parts_are_refused() {
        let config = DmpConfig { steps: 20, basis_functions: 10, ..DmpConfig::default() };
        let primitive = DmpPrimitive::fit(&config, &space(2), &demonstrations(2, 4)).unwrap();
        let text = serde_json::to_string(&primitive).unwrap();
        assert_eq!(serde_json::from_str::<DmpPrimitive>(&text).unwrap(), primitive);
        let odd = text.replacen("\"location\":1", "\"location\":2", 1);
        let error = serde_json::from_str::<DmpPrimitive>(&odd).unwrap_err().to_string();
        assert!(error.contains("a location that is none of the 2"), "{error}");
        let one = DmpConfig { basis_functions: 1, ..config };
        let error = DmpPrimitive::fit(&one, &space(2), &demonstrations(2, 4)).unwrap_err();
        assert_eq!(error.to_string(), "basis_functions is 1; it must be from 2 to 1000");
    }
}
