//! Inverse kinematics of one pose: damped least squares, kept inside the limits.
//!
//! Levenberg-Marquardt on the six-dimensional pose error (position in m, rotation vector in rad, one
//! metre weighing as much as one radian). A step solves `(J J^T + lambda I) y = e` and moves the
//! joints by `J^T y`: the matrix is 6 x 6 however many joints there are. Joints that stand at a
//! limit and would leave it are held, and steps are clamped to the limits. The damping follows the
//! error, `lambda = mu |e|^2` (Fan and Yuan 2005), so the last steps are nearly Gauss-Newton's. A
//! descent that stalls begins again elsewhere.

use nalgebra::{Cholesky, Isometry3, Matrix3, Matrix6, UnitQuaternion, Vector3, Vector6};
use rand::{Rng, RngExt};

use super::chain::Chain;
use super::forward::Frame;

/// Squared pose error at which a descent has nothing left to gain: a micrometre, a microradian.
const CONVERGED: f64 = 1e-12;

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
fn rotation_vector(rotation: &Matrix3<f64>) -> Vector3<f64> {
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
    pub(super) chain: &'a Chain,
    pub(super) q: Vec<f64>,
    columns: Vec<Vector6<f64>>,
    tip: Frame,
    trial: Vec<f64>,
    trial_columns: Vec<Vector6<f64>>,
    max_iterations: usize,
}

impl<'a> Solver<'a> {
    pub(super) fn new(chain: &'a Chain) -> Self {
        let zeros = vec![Vector6::zeros(); chain.dof()];
        let mut solver = Self {
            chain,
            q: chain.middle(),
            columns: zeros.clone(),
            tip: Frame { rotation: Matrix3::identity(), position: Vector3::zeros() },
            trial: vec![0.0; chain.dof()],
            trial_columns: zeros,
            max_iterations: 60,
        };
        solver.evaluate();
        solver
    }

    /// Stands at `q`, clamped to the limits.
    pub(super) fn start(&mut self, q: &[f64]) {
        for ((value, &from), joint) in self.q.iter_mut().zip(q).zip(self.chain.joints()) {
            *value = from.clamp(joint.lower, joint.upper);
        }
        self.evaluate();
    }

    /// Stands at a configuration drawn evenly from inside the limits.
    pub(super) fn start_anywhere<R: Rng + ?Sized>(&mut self, rng: &mut R) {
        for (value, joint) in self.q.iter_mut().zip(self.chain.joints()) {
            let (lower, upper) = if joint.lower.is_finite() && joint.upper.is_finite() {
                (joint.lower, joint.upper)
            } else {
                (-std::f64::consts::PI, std::f64::consts::PI)
            };
            *value = rng.random_range(lower..=upper);
        }
        self.evaluate();
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
        for _ in 0..self.max_iterations {
            if squared < CONVERGED {
                break;
            }
            let normal = self.normal(&residual.0);
            let lambda = mu * squared + 1e-10;
            let Some(y) = solve_damped(&normal, lambda, &residual.0) else { break };
            self.step(|column, _| column.dot(&y), &residual.0);
            let tip = self.chain.tip_and_jacobian(&self.trial, &mut self.trial_columns);
            let next = Residual::between(&tip, target);
            let next_squared = next.squared();
            if next_squared < squared {
                // A descent that gains less than a tenth three times in a row ends in a dead end.
                slow = if next_squared > 0.9 * squared { slow + 1 } else { 0 };
                self.accept(tip);
                (residual, squared) = (next, next_squared);
                mu = (mu * 0.25).max(1e-4);
                if slow == 3 {
                    break;
                }
            } else {
                mu *= 10.0;
                if mu > 1e6 {
                    break;
                }
            }
        }
        residual
    }

    /// Whether a joint stands at a limit and `direction` leads out of it.
    fn held(&self, joint: usize, direction: f64) -> bool {
        let limits = &self.chain.joints()[joint];
        let q = self.q[joint];
        (q >= limits.upper && direction > 0.0) || (q <= limits.lower && direction < 0.0)
    }

    /// `J J^T` over the joints that may move.
    fn normal(&self, residual: &Vector6<f64>) -> Matrix6<f64> {
        let mut normal = Matrix6::zeros();
        for (joint, column) in self.columns.iter().enumerate() {
            if !self.held(joint, column.dot(residual)) {
                normal.ger(1.0, column, column, 1.0);
            }
        }
        normal
    }

    /// The trial configuration: each joint that may move, moved by `delta`, clamped to its limits.
    fn step(&mut self, delta: impl Fn(&Vector6<f64>, usize) -> f64, residual: &Vector6<f64>) {
        for (joint, limits) in self.chain.joints().iter().enumerate() {
            let column = &self.columns[joint];
            self.trial[joint] = if self.held(joint, column.dot(residual)) {
                self.q[joint]
            } else {
                (self.q[joint] + delta(column, joint)).clamp(limits.lower, limits.upper)
            };
        }
    }

    fn accept(&mut self, tip: Frame) {
        self.tip = tip;
        std::mem::swap(&mut self.q, &mut self.trial);
        std::mem::swap(&mut self.columns, &mut self.trial_columns);
    }
}

/// `(normal + lambda I)^-1 e`.
fn solve_damped(normal: &Matrix6<f64>, lambda: f64, e: &Vector6<f64>) -> Option<Vector6<f64>> {
    let mut damped = *normal;
    for i in 0..6 {
        damped[(i, i)] += lambda;
    }
    Some(Cholesky::new(damped)?.solve(e))
}
