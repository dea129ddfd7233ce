//! Inverse kinematics of one pose: damped least squares, kept inside the limits.
//!
//! Levenberg-Marquardt on the six-dimensional pose error (position in m, rotation vector in rad, one
//! metre weighing as much as one radian). A step solves `(J J^T + lambda I) y = e` and moves the
//! joints by `J^T y`: the matrix is 6 x 6 however many joints there are. Joints that stand at a
//! limit and would leave it are held, and steps are clamped to the limits. The damping follows the
//! error, `lambda = mu |e|^2` (Fan and Yuan 2005), so the last steps are nearly Gauss-Newton's. A
//! descent that stalls begins again elsewhere.

use nalgebra::{Cholesky, Isometry3, Matrix3, Matrix6, UnitQuaternion, Vector3, Vector6};
use rand::Rng;

use super::chain::Chain;
use super::forward::Frame;

/// Squared pose error at which a descent has nothing left to gain: a micrometre, a microradian.
const CONVERGED: f64 = 1e-12;

/// Steps of one descent; one that converges takes 5 to 20.
const MAX_ITERATIONS: usize = 60;

/// Damping that is left where the error is 0; it keeps singular poses solvable.
const DAMPING: f64 = 1e-10;

/// A descent that three times in a row leaves more than this share of its squared error ends in a
/// dead end.
const SLOW: f64 = 0.9;

/// How close counts as reached.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tolerance {
    /// Largest distance (m).
    pub position_m: f64,
    /// Largest angle (rad).
    pub orientation_rad: f64,
}

impl Default for Tolerance {
    /// A millimetre and 0.01 rad.
    fn default() -> Self {
        Self { position_m: 1e-3, orientation_rad: 1e-2 }
    }
}

/// How hard to try.
#[derive(Debug, Clone, PartialEq)]
pub struct InverseOptions {
    /// How close counts as solved.
    pub tolerance: Tolerance,
    /// Random configurations to begin again from, after the seed.
    pub max_restarts: usize,
}

impl Default for InverseOptions {
    fn default() -> Self {
        Self { tolerance: Tolerance::default(), max_restarts: 200 }
    }
}

/// A configuration and how far its tip is from the pose asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct Configuration {
    /// Joint positions (rad, or m for prismatic joints), inside the limits.
    pub positions: Vec<f64>,
    /// Distance of the tip from the pose (m).
    pub position_error_m: f64,
    /// Angle of the tip from the pose (rad).
    pub orientation_error_rad: f64,
}

/// No configuration inside the limits was found that reaches the pose.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "the pose is {:.1} cm and {:.1} degrees out of reach of {tip_frame:?}",
    100.0 * nearest.position_error_m,
    nearest.orientation_error_rad.to_degrees()
)]
pub struct InverseError {
    /// The frame that was to reach the pose.
    pub tip_frame: String,
    /// The configuration that came nearest.
    pub nearest: Configuration,
}

/// Joint positions inside the limits that put the tip at `base_from_tip`: those that a descent from
/// `seed` finds, or the first that one from a random configuration finds.
///
/// # Errors
/// None was found; the nearest configuration is returned.
///
/// # Panics
/// When `seed` has not one value per joint.
pub fn solve<R: Rng + ?Sized>(
    chain: &Chain,
    base_from_tip: &Isometry3<f64>,
    seed: &[f64],
    options: &InverseOptions,
    rng: &mut R,
) -> Result<Configuration, InverseError> {
    chain.assert_dof(seed);
    let target = Frame::from(base_from_tip);
    let mut solver = Solver::new(chain);
    let mut nearest: Option<(f64, Configuration)> = None;
    for restart in 0..=options.max_restarts {
        if restart == 0 {
            solver.start(seed);
        } else {
            solver.start_anywhere(rng);
        }
        let residual = solver.descend(&target);
        if residual.within(&options.tolerance) {
            return Ok(solver.configuration(&residual));
        }
        if nearest.as_ref().is_none_or(|(squared, _)| residual.squared() < *squared) {
            nearest = Some((residual.squared(), solver.configuration(&residual)));
        }
    }
    let (_, nearest) = nearest.expect("at least the seed was tried");
    Err(InverseError { tip_frame: chain.tip_frame().into(), nearest })
}

/// From where the tip is to where it should be: position (m), then rotation vector (rad), in the
/// base frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Residual(pub(super) Vector6<f64>);

impl Residual {
    fn between(tip: &Frame, target: &Frame) -> Self {
        let position = target.position - tip.position;
        let rotation = rotation_vector(&(target.rotation * tip.rotation.transpose()));
        Self(Vector6::new(position.x, position.y, position.z, rotation.x, rotation.y, rotation.z))
    }

    pub(super) fn squared(&self) -> f64 {
        self.0.norm_squared()
    }

    pub(super) fn position_m(&self) -> f64 {
        self.0.fixed_rows::<3>(0).norm()
    }

    pub(super) fn orientation_rad(&self) -> f64 {
        self.0.fixed_rows::<3>(3).norm()
    }

    pub(super) fn within(&self, tolerance: &Tolerance) -> bool {
        self.position_m() <= tolerance.position_m
            && self.orientation_rad() <= tolerance.orientation_rad
    }
}

impl From<&Isometry3<f64>> for Frame {
    fn from(pose: &Isometry3<f64>) -> Self {
        Self {
            rotation: pose.rotation.to_rotation_matrix().into_inner(),
            position: pose.translation.vector,
        }
    }
}

/// The rotation vector of a rotation matrix.
pub(super) fn rotation_vector(rotation: &Matrix3<f64>) -> Vector3<f64> {
    let r = rotation;
    // Twice the sine times the axis.
    let twice = Vector3::new(r.m32 - r.m23, r.m13 - r.m31, r.m21 - r.m12);
    let cosine = 0.5 * (r.trace() - 1.0);
    let sine = 0.5 * twice.norm();
    if cosine < -0.9 {
        // Near a half turn the sine loses the axis.
        UnitQuaternion::from_matrix_eps(r, 1e-12, 100, UnitQuaternion::identity()).scaled_axis()
    } else if sine < 1e-9 {
        0.5 * twice
    } else {
        twice * (0.5 * sine.atan2(cosine) / sine)
    }
}

/// One configuration on its way to a pose. All buffers are made once.
#[derive(Debug, Clone)]
pub(super) struct Solver<'a> {
    chain: &'a Chain,
    pub(super) q: Vec<f64>,
    pub(super) lower: Vec<f64>,
    pub(super) upper: Vec<f64>,
    middle: Vec<f64>,
    half_range: Vec<f64>,
    columns: Vec<Vector6<f64>>,
    tip: Frame,
    trial: Vec<f64>,
    trial_columns: Vec<Vector6<f64>>,
}

impl<'a> Solver<'a> {
    pub(super) fn new(chain: &'a Chain) -> Self {
        let joints = chain.joints();
        let zeros = vec![Vector6::zeros(); chain.dof()];
        let mut solver = Self {
            chain,
            q: chain.middle(),
            lower: joints.iter().map(|j| j.lower).collect(),
            upper: joints.iter().map(|j| j.upper).collect(),
            middle: chain.middle(),
            half_range: joints.iter().map(|j| 0.5 * (j.upper - j.lower)).collect(),
            columns: zeros.clone(),
            tip: Frame { rotation: Matrix3::identity(), position: Vector3::zeros() },
            trial: vec![0.0; chain.dof()],
            trial_columns: zeros,
        };
        solver.evaluate();
        solver
    }

    /// A solver that keeps each joint so far inside its limits, but no further than a tenth of its range.
    pub(super) fn inside(chain: &'a Chain, margin: f64) -> Self {
        let mut solver = Self::new(chain);
        for joint in 0..chain.dof() {
            let margin = margin.min(0.2 * solver.half_range[joint]);
            solver.lower[joint] += margin;
            solver.upper[joint] -= margin;
        }
        solver
    }

    /// A solver for which no joint has limits.
    pub(super) fn without_limits(chain: &'a Chain) -> Self {
        let mut solver = Self::new(chain);
        solver.lower.fill(f64::NEG_INFINITY);
        solver.upper.fill(f64::INFINITY);
        solver
    }

    /// Stands at `q`, clamped to the limits.
    pub(super) fn start(&mut self, q: &[f64]) {
        for (joint, &value) in q.iter().enumerate() {
            self.q[joint] = value.clamp(self.lower[joint], self.upper[joint]);
        }
        self.evaluate();
    }

    /// Stands at a configuration drawn evenly from inside the chain's limits; from a full turn
    /// for a joint without.
    pub(super) fn start_anywhere<R: Rng + ?Sized>(&mut self, rng: &mut R) {
        let drawn = self.chain.draw(rng);
        self.start(&drawn);
    }

    fn evaluate(&mut self) {
        self.tip = self.chain.tip_and_jacobian(&self.q, &mut self.columns);
    }

    pub(super) fn configuration(&self, residual: &Residual) -> Configuration {
        Configuration {
            positions: self.q.clone(),
            position_error_m: residual.position_m(),
            orientation_error_rad: residual.orientation_rad(),
        }
    }

    /// Descends to `target` from where it stands; ends at the best configuration met.
    pub(super) fn descend(&mut self, target: &Frame) -> Residual {
        let mut residual = Residual::between(&self.tip, target);
        let mut squared = residual.squared();
        let mut mu = 1e-2;
        let mut slow = 0;
        for _ in 0..MAX_ITERATIONS {
            if squared < CONVERGED {
                break;
            }
            let Some(y) = self.damped(&residual.0, mu * squared + DAMPING, &residual.0) else {
                break;
            };
            for joint in 0..self.q.len() {
                let column = &self.columns[joint];
                self.trial[joint] = if self.held(joint, column.dot(&residual.0)) {
                    self.q[joint]
                } else {
                    (self.q[joint] + column.dot(&y)).clamp(self.lower[joint], self.upper[joint])
                };
            }
            let tip = self.chain.tip_and_jacobian(&self.trial, &mut self.trial_columns);
            let next = Residual::between(&tip, target);
            let next_squared = next.squared();
            if next_squared < squared {
                slow = if next_squared > SLOW * squared { slow + 1 } else { 0 };
                self.accept(tip);
                (residual, squared) = (next, next_squared);
                mu = (mu * 0.25).max(1e-4);
            } else {
                mu *= 10.0;
            }
            if slow == 3 || mu > 1e6 {
                break;
            }
        }
        residual
    }

    /// Descends to `target`, a small step away, and on the way uses what freedom the pose leaves to
    /// move joints off their limits: by the share `pull` of the way to the middle at the limit
    /// itself, by less with the square of the distance from the middle.
    pub(super) fn track(&mut self, target: &Frame, pull: f64) -> Residual {
        let residual = Residual::between(&self.tip, target);
        // The joints' motion is z + J^+ (e - J z): z as far as it leaves the pose alone.
        let wish = |solver: &Self, joint: usize| {
            let offset = solver.q[joint] - solver.middle[joint];
            let share = offset / solver.half_range[joint];
            -pull * share * share * offset
        };
        let mut remaining = residual.0;
        for joint in 0..self.q.len() {
            remaining -= self.columns[joint] * wish(self, joint);
        }
        if let Some(y) = self.damped(&remaining, 1e-6, &residual.0) {
            for joint in 0..self.q.len() {
                let column = &self.columns[joint];
                let step = if self.held(joint, column.dot(&residual.0)) {
                    wish(self, joint)
                } else {
                    wish(self, joint) + column.dot(&y)
                };
                self.trial[joint] =
                    (self.q[joint] + step).clamp(self.lower[joint], self.upper[joint]);
            }
            let tip = self.chain.tip_and_jacobian(&self.trial, &mut self.trial_columns);
            self.accept(tip);
        }
        self.descend(target)
    }

    /// `(J J^T + lambda I)^-1 e` over the joints that `residual` does not press against a limit.
    fn damped(
        &self,
        e: &Vector6<f64>,
        lambda: f64,
        residual: &Vector6<f64>,
    ) -> Option<Vector6<f64>> {
        let mut normal = Matrix6::from_diagonal_element(lambda);
        for (joint, column) in self.columns.iter().enumerate() {
            if !self.held(joint, column.dot(residual)) {
                normal.ger(1.0, column, column, 1.0);
            }
        }
        Some(Cholesky::new(normal)?.solve(e))
    }

    /// Whether a joint stands at a limit and `direction` leads out of it.
    fn held(&self, joint: usize, direction: f64) -> bool {
        let q = self.q[joint];
        (q >= self.upper[joint] && direction > 0.0) || (q <= self.lower[joint] && direction < 0.0)
    }

    fn accept(&mut self, tip: Frame) {
        self.tip = tip;
        std::mem::swap(&mut self.q, &mut self.trial);
        std::mem::swap(&mut self.columns, &mut self.trial_columns);
    }
}
