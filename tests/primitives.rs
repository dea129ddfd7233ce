//! The classical primitives against other programs' numbers; `golden/primitives/primitives.py` made
//! them, and says by which programs.

use nalgebra::{DMatrix, DVector, Quaternion, UnitQuaternion};
use serde::Deserialize;
use tcvae::Trajectory;
use tcvae::primitives::dmp::{Dmp, DmpConfig, OrientationDmp};
use tcvae::primitives::dtw::{StepPattern, warp};
use tcvae::primitives::gmm::{Gaussian, Gmm};
use tcvae::primitives::promp::{MotionDistribution, weights};
use tcvae::primitives::tp_gmm::{Frame, FramedGmm, TpGmmConfig};

type Rows = Vec<Vec<f64>>;

fn trajectory(rows: &Rows) -> Trajectory {
    Trajectory::new(rows[0].len(), rows.concat()).expect("a trajectory")
}

fn matrix(rows: &Rows) -> DMatrix<f64> {
    DMatrix::from_row_slice(rows.len(), rows[0].len(), &rows.concat())
}

fn vector(values: &[f64]) -> DVector<f64> {
    DVector::from_column_slice(values)
}

/// That no value differs by more than `tolerance` of the largest one.
#[track_caller]
fn assert_close(found: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len());
    let scale = expected.iter().fold(1e-300, |a: f64, b| a.max(b.abs()));
    for (i, (a, b)) in found.iter().zip(expected).enumerate() {
        assert!((a - b).abs() <= tolerance * scale, "value {i}: {a} where {b} is expected");
    }
}

#[derive(Deserialize)]
struct GoldenWarping {
    name: String,
    pattern: String,
    query: Rows,
    reference: Rows,
    distance: f64,
    window: Option<usize>,
    path: Vec<(usize, usize)>,
}

#[test]
fn warpings_are_those_of_dtw_python() {
    let golden: Vec<GoldenWarping> =
        serde_json::from_str(include_str!("golden/primitives/dtw.json")).expect("JSON");
    for case in golden {
        let pattern = match case.pattern.as_str() {
            "symmetric1" => StepPattern::Symmetric1,
            _ => StepPattern::Symmetric2,
        };
        let found =
            warp(&trajectory(&case.query), &trajectory(&case.reference), pattern, case.window);
        let GoldenWarping { name, distance, path, .. } = case;
        assert!((found.distance - distance).abs() < 1e-10 * distance, "{name}");
        assert_eq!(found.path, path, "{name}");
    }
}

#[derive(Deserialize)]
struct GoldenMixture {
    weights: Vec<f64>,
    means: Rows,
    covariances: Vec<Rows>,
}

impl GoldenMixture {
    fn gmm(&self) -> Gmm {
        let gaussian = |(mean, covariance): (&Vec<f64>, &Rows)| Gaussian {
            mean: vector(mean),
            covariance: matrix(covariance),
        };
        let components = self.means.iter().zip(&self.covariances).map(gaussian).collect();
        Gmm { weights: self.weights.clone(), components }
    }

    #[track_caller]
    fn assert_close(&self, found: &Gmm, tolerance: f64) {
        let expected = self.gmm();
        assert_close(&found.weights, &expected.weights, tolerance);
        for (a, b) in found.components.iter().zip(&expected.components) {
            assert_close(a.mean.as_slice(), b.mean.as_slice(), tolerance);
            assert_close(a.covariance.as_slice(), b.covariance.as_slice(), tolerance);
        }
    }
}

#[derive(Deserialize)]
struct GoldenGmm {
    samples: Rows,
    start: GoldenMixture,
    fitted: Vec<GoldenFit>,
    regressions: Vec<GoldenRegression>,
}

#[derive(Deserialize)]
struct GoldenFit {
    iterations: usize,
    mixture: GoldenMixture,
    mean_log_likelihood: f64,
    bic: f64,
}

#[derive(Deserialize)]
struct GoldenRegression {
    input: Vec<f64>,
    mean: Vec<f64>,
    covariance: Rows,
}

fn golden_gmm() -> GoldenGmm {
    serde_json::from_str(include_str!("golden/primitives/gmm.json")).expect("JSON")
}

#[test]
fn steps_of_the_optimisation_are_those_of_scikit_learn() {
    let GoldenGmm { samples, start, fitted, .. } = golden_gmm();
    let samples = matrix(&samples).transpose();
    for GoldenFit { iterations, mixture, mean_log_likelihood, bic } in fitted {
        let mut gmm = start.gmm();
        for _ in 0..iterations {
            gmm = gmm.stepped(&samples, 1e-6).expect("regular covariances");
        }
        mixture.assert_close(&gmm, 1e-8);
        let found = [gmm.mean_log_likelihood(&samples), gmm.bic(&samples)];
        let found = found.map(|v| v.expect("regular covariances"));
        assert_close(&found[..1], &[mean_log_likelihood], 1e-9);
        assert_close(&found[1..], &[bic], 1e-9);
    }
}

#[test]
fn regressions_are_those_of_gmr() {
    let GoldenGmm { start, regressions, .. } = golden_gmm();
    let gmm = start.gmm();
    for GoldenRegression { input, mean, covariance } in regressions {
        let found = gmm.regression(input.len()).expect("regular covariances").at(&input);
        assert_close(found.mean.as_slice(), &mean, 1e-9);
        assert_close(found.covariance.as_slice(), matrix(&covariance).as_slice(), 1e-9);
    }
}

#[derive(Deserialize)]
struct GoldenFrame {
    matrix: Rows,
    origin: Vec<f64>,
}

#[derive(Deserialize)]
struct GoldenTpGmm {
    components: usize,
    iterations: usize,
    regularization: f64,
    motions: Vec<Rows>,
    frames: Vec<Vec<GoldenFrame>>,
    new_frames: Vec<GoldenFrame>,
    product: GoldenMixture,
    mean: Rows,
    covariance: Vec<Rows>,
}

#[test]
fn a_task_parameterised_mixture_is_the_one_of_the_papers_equations() {
    let golden: GoldenTpGmm =
        serde_json::from_str(include_str!("golden/primitives/tp_gmm.json")).expect("JSON");
    let frames = |golden: &Vec<GoldenFrame>| -> Vec<Frame> {
        let frame =
            |f: &GoldenFrame| Frame { matrix: matrix(&f.matrix), origin: vector(&f.origin) };
        golden.iter().map(frame).collect()
    };
    let config = TpGmmConfig {
        components: golden.components,
        max_iterations: golden.iterations,
        // Every step is taken, whatever it gains.
        tolerance: -1.0,
        regularization: golden.regularization,
        ..TpGmmConfig::default()
    };
    let motions: Vec<Trajectory> = golden.motions.iter().map(trajectory).collect();
    let demonstrated: Vec<_> = golden.frames.iter().map(frames).collect();
    let fitted = FramedGmm::fit(&config, &motions, &demonstrated).expect("regular covariances");
    let product = fitted.in_world(&frames(&golden.new_frames)).expect("regular covariances");
    golden.product.assert_close(&product, 1e-6);
    let regression = product.regression(1).expect("regular covariances");
    let steps = golden.mean.len();
    for (t, (mean, covariance)) in golden.mean.iter().zip(&golden.covariance).enumerate() {
        let found = regression.at(&[t as f64 / (steps - 1) as f64]);
        assert_close(found.mean.as_slice(), mean, 1e-6);
        assert_close(found.covariance.as_slice(), matrix(covariance).as_slice(), 1e-6);
    }
}

#[derive(Deserialize)]
struct GoldenProMp {
    name: String,
    basis_functions: usize,
    ridge: f64,
    motions: Vec<Rows>,
    weights: Rows,
    mean: Rows,
    variance: Rows,
    via: GoldenVia,
    through_mean: Rows,
    through_variance: Rows,
}

#[derive(Deserialize)]
struct GoldenVia {
    phase: f64,
    state: Vec<f64>,
    variance: f64,
}

#[test]
fn weights_and_via_points_are_those_of_movement_primitives_promp() {
    let golden: Vec<GoldenProMp> =
        serde_json::from_str(include_str!("golden/primitives/promp.json")).expect("JSON");
    for case in golden {
        println!("{}", case.name);
        let found: Vec<DVector<f64>> = case
            .motions
            .iter()
            .map(|m| weights(&trajectory(m), case.basis_functions, case.ridge).expect("regular"))
            .collect();
        for (found, expected) in found.iter().zip(&case.weights) {
            assert_close(found.as_slice(), expected, 1e-6);
        }
        let columns = DMatrix::from_columns(&found);
        let mean = columns.column_mean();
        let apart = &columns - &mean * DMatrix::from_element(1, found.len(), 1.0);
        let covariance = &apart * apart.transpose() / (found.len() - 1) as f64;
        let state_dim = case.mean[0].len();
        let motions = MotionDistribution { state_dim, mean, covariance };
        let steps = case.mean.len();
        let (mean, variance) = motions.marginals(steps);
        assert_close(&mean, &case.mean.concat(), 1e-9);
        assert_close(&variance, &case.variance.concat(), 1e-9);
        let GoldenVia { phase, state, variance } = case.via;
        let through = motions.through(phase, &state, variance).expect("a variance above 0");
        let (mean, variance) = through.marginals(steps);
        assert_close(&mean, &case.through_mean.concat(), 1e-8);
        assert_close(&variance, &case.through_variance.concat(), 1e-8);
    }
}

#[derive(Deserialize)]
struct GoldenDmps {
    vectors: Vec<GoldenDmp>,
    orientations: Vec<GoldenOrientationDmp>,
}

#[derive(Deserialize)]
struct GoldenDmp {
    name: String,
    basis_functions: usize,
    ridge: f64,
    smooth_scaling: bool,
    motion: Rows,
    weights: Rows,
    repeated: Rows,
    start: Vec<f64>,
    goal: Vec<f64>,
    moved: Rows,
}

#[derive(Deserialize)]
struct GoldenOrientationDmp {
    name: String,
    basis_functions: usize,
    ridge: f64,
    smooth_scaling: bool,
    quaternions_wxyz: Vec<[f64; 4]>,
    weights: Rows,
    repeated: Vec<[f64; 4]>,
    goal: [f64; 4],
    moved: Vec<[f64; 4]>,
}

fn golden_dmps() -> GoldenDmps {
    serde_json::from_str(include_str!("golden/primitives/dmp.json")).expect("JSON")
}

#[test]
fn fits_and_rollouts_are_those_of_movement_primitives_dmp() {
    for case in golden_dmps().vectors {
        println!("{}", case.name);
        let GoldenDmp { basis_functions, ridge, smooth_scaling, .. } = case;
        let config = DmpConfig { basis_functions, ridge, smooth_scaling, ..DmpConfig::default() };
        let dmp = Dmp::fit(&config, &trajectory(&case.motion)).expect("a ridge");
        assert_close(dmp.weights.as_slice(), matrix(&case.weights).as_slice(), 1e-6);
        let steps = case.motion.len();
        let repeated = dmp.rollout(&dmp.start, &dmp.goal, steps);
        assert_close(repeated.values(), &case.repeated.concat(), 1e-7);
        let moved = dmp.rollout(&vector(&case.start), &vector(&case.goal), steps);
        assert_close(moved.values(), &case.moved.concat(), 1e-7);
    }
}

#[test]
fn fits_and_rollouts_are_those_of_movement_primitives_cartesian_dmp() {
    let quaternion =
        |[w, x, y, z]: [f64; 4]| UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    for case in golden_dmps().orientations {
        println!("{}", case.name);
        let GoldenOrientationDmp { basis_functions, ridge, smooth_scaling, .. } = case;
        let config = DmpConfig { basis_functions, ridge, smooth_scaling, ..DmpConfig::default() };
        let orientations: Vec<_> = case.quaternions_wxyz.into_iter().map(quaternion).collect();
        let dmp = OrientationDmp::fit(&config, &orientations).expect("a ridge");
        assert_close(dmp.weights.as_slice(), matrix(&case.weights).as_slice(), 1e-6);
        let steps = orientations.len();
        for (goal, expected) in [(dmp.goal, case.repeated), (quaternion(case.goal), case.moved)] {
            let found = dmp.rollout(&dmp.start, &goal, steps);
            assert_eq!(found.len(), expected.len());
            for (found, expected) in found.iter().zip(expected) {
                let angle = found.angle_to(&quaternion(expected));
                assert!(angle < 1e-6, "{angle}");
            }
        }
    }
}
