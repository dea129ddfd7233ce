//! How well predicted deviations fit errors, and what makes them fit: a decoder predicts what its training part
//! left over, which is not what others will, so its deviations are scaled by what the validation part shows.

use serde::{Deserialize, Serialize};

use super::manners;
use crate::demonstrations::Demonstration;
use crate::model::Recognition;
use crate::pose::{self, BAND_STDDEVS, DeviationScale, STATE_DIM};
use crate::primitive::{Generated, MannerConditioned};
use crate::trajectory::Trajectory;

/// Share of the demonstrated positions that the band around a motion is to hold.
const IN_BAND: f64 = 0.95;

/// How well predicted deviations fit errors: those of the reconstructions from the posterior means,
/// over all steps and state values.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// Share of the errors within one predicted deviation; .683 where they are normal and the
    /// prediction is right.
    pub within_one: f64,
    /// Share within 1.96 predicted deviations; .95 likewise.
    pub within_two: f64,
    /// Root mean square of the errors in predicted deviations; 1 likewise, above 1 where the model
    /// is surer than it should be.
    pub rms: f64,
    /// Share of the positions inside the band that is shown around a motion, .95 where it is right; none
    /// where states are no poses.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub position_in_band: Option<f64>,
    /// The same of the orientations.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub orientation_in_band: Option<f64>,
}

/// Errors in predicted deviations, over all steps of all cases.
#[derive(Debug, Default)]
pub(super) struct Standardised {
    values: Vec<f64>,
    /// Distances, where states are poses.
    positions: Vec<f64>,
    /// Lengths of the rotation vectors' errors, likewise.
    orientations: Vec<f64>,
}

impl Standardised {
    /// Adds the errors of a reconstruction, the demonstration resampled to the model's steps.
    pub(super) fn add(&mut self, Generated { mean, stddev, .. }: &Generated, shown: &Trajectory) {
        let shown = shown.resampled(mean.steps());
        for ((mean, stddev), shown) in mean.states().zip(stddev.states()).zip(shown.states()) {
            let errors: Vec<f64> = mean.iter().zip(shown).map(|(a, b)| a - b).collect();
            self.values
                .extend(errors.iter().zip(stddev).map(|(error, deviation)| error / deviation));
            if mean.len() == STATE_DIM {
                let length = |e: &[f64]| e.iter().map(|e| e * e).sum::<f64>().sqrt();
                self.positions.push(length(&errors[..3]) / pose::position_stddev(stddev));
                self.orientations.push(length(&errors[3..]) / pose::orientation_stddev(stddev));
            }
        }
    }

    pub(super) fn calibration(&self) -> Calibration {
        let values = &self.values;
        let in_band =
            |lengths: &[f64]| (!lengths.is_empty()).then(|| within(lengths, BAND_STDDEVS));
        Calibration {
            within_one: within(values, 1.0),
            within_two: within(values, 1.96),
            rms: (values.iter().map(|e| e * e).sum::<f64>() / values.len() as f64).sqrt(),
            position_in_band: in_band(&self.positions),
            orientation_in_band: in_band(&self.orientations),
        }
    }
}

fn within(errors: &[f64], limit: f64) -> f64 {
    errors.iter().filter(|e| e.abs() <= limit).count() as f64 / errors.len() as f64
}

/// What the deviations of a model have to be multiplied by so that the band holds 95 % of what `shown`
/// demonstrates; none where states are no poses, or nothing is shown. The model's own scale is not undone.
///
/// # Panics
/// When `recognition` does not answer for every demonstration.
pub fn deviation_scale<M, R>(
    model: &M,
    recognition: &R,
    shown: &[Demonstration],
) -> Option<DeviationScale>
where
    M: MannerConditioned + ?Sized,
    R: Recognition + ?Sized,
{
    let mut errors = Standardised::default();
    for (demonstration, h) in shown.iter().zip(manners(model, recognition, shown)) {
        errors.add(&model.decode(&demonstration.w, &h), &demonstration.motion.states);
    }
    let Standardised { mut positions, mut orientations, .. } = errors;
    let scale = |lengths: &mut Vec<f64>| {
        lengths.sort_by(f64::total_cmp);
        let inside = (IN_BAND * lengths.len() as f64).ceil() as usize;
        // Nothing is so sure that it is certain.
        lengths.get(inside.saturating_sub(1)).map(|length| (length / BAND_STDDEVS).max(1e-3))
    };
    Some(DeviationScale {
        position: scale(&mut positions)?,
        orientation: scale(&mut orientations)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::STATE_DIM;
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    fn standardised(stddev: [f64; STATE_DIM], true_stddev: [f64; STATE_DIM]) -> Standardised {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut errors = Standardised::default();
        let repeated =
            |values: [f64; STATE_DIM]| Trajectory::new(STATE_DIM, values.repeat(100)).unwrap();
        let mean = repeated([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]);
        for _ in 0..200 {
            let noisy = mean.states().flat_map(|state| {
                let normal: [f64; STATE_DIM] =
                    std::array::from_fn(|_| StandardNormal.sample(&mut rng));
                std::array::from_fn::<f64, STATE_DIM, _>(|i| state[i] + true_stddev[i] * normal[i])
            });
            let shown = Trajectory::new(STATE_DIM, noisy.collect()).unwrap();
            let generated =
                Generated { mean: mean.clone(), stddev: repeated(stddev), duration_secs: None };
            errors.add(&generated, &shown);
        }
        errors
    }

    #[test]
    fn right_deviations_hold_what_a_normal_distribution_says() {
        let stddev = [0.01, 0.01, 0.01, 0.1, 0.1, 0.1];
        let calibration = standardised(stddev, stddev).calibration();
        for (found, expected) in [
            (calibration.within_one, 0.683),
            (calibration.within_two, 0.95),
            (calibration.rms, 1.0),
            (calibration.position_in_band.unwrap(), 0.95),
            (calibration.orientation_in_band.unwrap(), 0.95),
        ] {
            assert!((found - expected).abs() < 0.01, "{calibration:?}");
        }
    }

    #[test]
    fn a_model_that_is_too_sure_is_found_out_part_by_part() {
        let predicted = [0.005, 0.005, 0.005, 0.2, 0.2, 0.2];
        let calibration = standardised(predicted, [0.01, 0.01, 0.01, 0.1, 0.1, 0.1]).calibration();
        assert!(calibration.position_in_band.unwrap() < 0.65);
        assert!(calibration.orientation_in_band.unwrap() > 0.99);
    }
}
