//! A trained TC-VAE as a movement primitive: f64 and units outside, the packed decoder inside.

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use super::config::ModelConfig;
use super::normalizer::{Normalizer, Units};
use super::packed::{PackedDecoder, Workspace};
use super::prior::LearnedPrior;
use super::{ModelError, Weights};
use crate::alignment::Alignment;
use crate::parameters::{MannerParameters, MannerSpace, TaskParameters, TaskSpace};
use crate::pose::{DeviationScale, STATE_DIM, TURN_DIM, from_turns};
use crate::primitive::{Generated, MannerConditioned, MovementPrimitive};
use crate::trajectory::Trajectory;

/// Draws of a manner parameter before it is cut off at its bounds instead of drawn again.
const MAX_DRAWS: usize = 1000;

/// Bound of a decoded duration's logarithm, far beyond any data, so that it stays finite and above 0.
const LOG_SECS: f64 = 20.0;

/// Bound of a decoded axis and first orientation (rad), likewise.
const MAX_TURN: f64 = 1e3;

/// A trained TC-VAE.
#[derive(Debug, Clone)]
pub struct TcVaePrimitive {
    units: Units,
    decoder: PackedDecoder,
    prior: Option<LearnedPrior>,
    deviation_scale: Option<DeviationScale>,
    task_space: TaskSpace,
    manner_space: MannerSpace,
}

impl TcVaePrimitive {
    /// The primitive with these weights.
    ///
    /// # Errors
    /// Anything that does not fit together: sizes, missing tensors, values that are not finite,
    /// weights that decode to something that is not finite.
    pub fn new(
        config: &ModelConfig,
        normalizer: &Normalizer,
        weights: &Weights,
        task_space: TaskSpace,
        manner_space: MannerSpace,
    ) -> Result<Self, ModelError> {
        config.check()?;
        for (name, found, expected) in [
            ("task", task_space.dim(), config.task_dim),
            ("manner", manner_space.dim(), config.network.latents),
        ] {
            if found != expected {
                return Err(ModelError::Space { name, found, expected });
            }
        }
        let units = Units::new(config, normalizer, weights)?;
        let decoder = PackedDecoder::new(config, weights)?;
        let prior = match config.network.prior_components {
            0 => None,
            k => Some(LearnedPrior::from_weights(config.network.latents, k, weights)?),
        };
        let primitive =
            Self { units, decoder, prior, deviation_scale: None, task_space, manner_space };
        if primitive.decodes_to_numbers() { Ok(primitive) } else { Err(ModelError::NotFinite) }
    }

    /// The primitive with its deviations scaled by this.
    ///
    /// # Errors
    /// Factors that are not above 0; states that are no poses.
    pub fn with_deviation_scale(self, scale: DeviationScale) -> Result<Self, ModelError> {
        if !scale.is_positive() {
            let (name, found) = ("deviation_scale", vec![scale.position, scale.orientation]);
            return Err(ModelError::Normalizer { name, found, expected: 2 });
        }
        let (name, found, expected) = ("pose", STATE_DIM, self.state_dim());
        if found != expected {
            return Err(ModelError::Space { name, found, expected });
        }
        Ok(Self { deviation_scale: Some(scale), ..self })
    }

    /// Whether the decoder stays finite in the middle of the tasks, at the prior's mean and at the ends
    /// of every manner parameter.
    fn decodes_to_numbers(&self) -> bool {
        let mean = MannerParameters::mean(&self.manner_space).values().to_vec();
        let ends = self.manner_space.axes().iter().enumerate().flat_map(|(i, axis)| {
            [axis.lower, axis.upper].map(|end| {
                let mut h = mean.clone();
                h[i] = end;
                h
            })
        });
        let w = vec![0.0; self.decoder.config().task_dim];
        let mut workspace = self.workspace();
        [mean.clone()].into_iter().chain(ends).all(|h| {
            let latents = self.latents(&h).iter().map(|h| *h as f32).collect::<Vec<_>>();
            let decoded = self.decoder.decode(&latents, &w, &mut workspace);
            decoded.mean.iter().chain(decoded.log_variance).all(|v| v.is_finite())
        })
    }

    /// What the decoder is given for manner parameters.
    fn latents(&self, h: &[f64]) -> Vec<f64> {
        match &self.prior {
            Some(prior) => prior.latents(h),
            None => h.to_vec(),
        }
    }

    /// Buffers for [`Self::decode_with`].
    pub fn workspace(&self) -> Workspace {
        self.decoder.workspace(1)
    }

    /// [`MannerConditioned::decode`] with buffers that are kept between calls.
    ///
    /// # Panics
    /// When the workspace is another model's.
    pub fn decode_with(
        &self,
        w: &TaskParameters,
        h: &MannerParameters,
        workspace: &mut Workspace,
    ) -> Generated {
        self.decode_at(w, &self.latents(h.values()), workspace)
    }

    fn decode_at(
        &self,
        w: &TaskParameters,
        latents: &[f64],
        workspace: &mut Workspace,
    ) -> Generated {
        let task = self.units.task(w.values());
        let latents: Vec<f32> = latents.iter().map(|h| *h as f32).collect();
        let decoded = self.decoder.decode(&latents, &task, workspace);
        let scale = || self.units.normalizer.state_scale.iter().cycle();
        let residual = decoded.mean.iter().zip(scale()).map(|(x, scale)| f64::from(*x) * scale);
        let centre = self.units.centre(&task);
        let mean = residual.zip(centre).map(|(residual, centre)| centre + residual);
        let deviations = decoded.log_variance.iter().zip(scale());
        let stddev = deviations.map(|(v, scale)| (0.5 * f64::from(*v)).exp() * scale);
        let (mean, stddev): (Vec<_>, Vec<_>) = (mean.collect(), stddev.collect());
        let config = self.decoder.config();
        let channels = config.state_dim;
        // The steps of the motion, without the margins.
        let steps = config.margin() * channels..(config.margin() + self.steps()) * channels;
        let as_turns = config.network.orientations_as_turns;
        // What changes along the motion, and what is the same at each step: the mean over them.
        let dim = if as_turns { TURN_DIM } else { config.motion_dim() };
        let changing = |values: &[f64]| {
            let states = values[steps.clone()].chunks_exact(channels).flat_map(|row| &row[..dim]);
            Trajectory::new(dim, states.copied().collect())
                .expect("finite weights were checked, and tasks and manners are bounded")
        };
        let constant = |values: &[f64], i: usize| {
            let rows = values[steps.clone()].chunks_exact(channels);
            rows.map(|row| row[i]).sum::<f64>() / self.steps() as f64
        };
        let (mut mean_states, mut stddev_states) = (changing(&mean), changing(&stddev));
        let mut duration_secs = None;
        if config.network.segments > 0 {
            let secs = |i| constant(&mean, i).clamp(-LOG_SECS, LOG_SECS).exp();
            let segments: Vec<f64> =
                (channels - config.network.segments..channels).map(secs).collect();
            let clock = Alignment::new(&segments);
            mean_states = clock.in_time(&mean_states);
            // Between steps by their logarithm, which stays above 0.
            let log_stddev = mapped(&stddev_states, f64::ln);
            stddev_states = mapped(&clock.in_time(&log_stddev), f64::exp);
            duration_secs = Some(segments.iter().sum());
        }
        if as_turns {
            let constants = |values: &[f64]| {
                std::array::from_fn(|i| constant(values, dim + i).clamp(-MAX_TURN, MAX_TURN))
            };
            let (constants, of_constants) = (constants(&mean), constants(&stddev));
            let states = (&mean_states, &stddev_states);
            (mean_states, stddev_states) = from_turns(states, (&constants, &of_constants));
        }
        if let Some(scale) = &self.deviation_scale {
            stddev_states = scale.scaled(&stddev_states);
        }
        Generated { mean: mean_states, stddev: stddev_states, duration_secs }
    }
}

fn mapped(trajectory: &Trajectory, f: fn(f64) -> f64) -> Trajectory {
    let values = trajectory.values().iter().map(|v| f(*v)).collect();
    Trajectory::new(trajectory.dim(), values).expect("deviations are finite and above 0")
}

impl MovementPrimitive for TcVaePrimitive {
    fn task_space(&self) -> &TaskSpace {
        &self.task_space
    }

    fn steps(&self) -> usize {
        self.decoder.config().motion_steps()
    }

    fn state_dim(&self) -> usize {
        self.decoder.config().motion_dim()
    }

    fn generate(&self, w: &TaskParameters) -> Generated {
        self.decode(w, &MannerParameters::mean(&self.manner_space))
    }
}

impl MannerConditioned for TcVaePrimitive {
    fn manner_space(&self) -> &MannerSpace {
        &self.manner_space
    }

    fn decode(&self, w: &TaskParameters, h: &MannerParameters) -> Generated {
        self.decode_with(w, h, &mut self.workspace())
    }

    fn sample_manner(&self, rng: &mut dyn Rng) -> MannerParameters {
        let axes = self.manner_space.axes();
        let draw = |axis: &crate::parameters::MannerAxis| {
            let mut draws = (0..MAX_DRAWS).map(|_| StandardNormal.sample(rng));
            let inside = draws.find(|h: &f64| (axis.lower..=axis.upper).contains(h));
            inside.unwrap_or_else(|| 0f64.clamp(axis.lower, axis.upper))
        };
        MannerParameters::new(&self.manner_space, axes.iter().map(draw).collect())
            .expect("every value lies inside its bounds")
    }

    fn manner(&self, latents: &[f64]) -> MannerParameters {
        match &self.prior {
            Some(prior) => MannerParameters::clamped(&self.manner_space, &prior.manner(latents)),
            None => MannerParameters::clamped(&self.manner_space, latents),
        }
    }

    fn decode_latents(&self, w: &TaskParameters, latents: &[f64]) -> Generated {
        match &self.prior {
            Some(_) => self.decode_at(w, latents, &mut self.workspace()),
            None => self.decode(w, &self.manner(latents)),
        }
    }

    fn has_learned_prior(&self) -> bool {
        self.prior.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::super::NamedTensor;
    use super::super::config::Activation;
    use super::super::layout::tests::{small, weights};
    use super::super::normalizer::tests::{demonstrations, space};
    use super::*;
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    fn primitive(bound: f64) -> TcVaePrimitive {
        let config = small(Activation::Gelu, true);
        let units = Units::fit(&config, &demonstrations(50, config.steps, 1));
        let manner = MannerSpace::unnamed(3, bound);
        TcVaePrimitive::new(&config, &units.normalizer, &weights(&config, 1), space(), manner)
            .unwrap()
    }

    #[test]
    fn a_kept_workspace_decodes_as_a_new_one_does() {
        let primitive = primitive(3.0);
        let mut workspace = primitive.workspace();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for d in demonstrations(5, 12, 2) {
            let h = primitive.sample_manner(&mut rng);
            let kept = primitive.decode_with(&d.w, &h, &mut workspace);
            assert_eq!(kept, primitive.decode(&d.w, &h));
        }
    }

    #[test]
    fn sampled_manners_are_standard_normal_inside_their_bounds() {
        let primitive = primitive(1.5);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let draws: Vec<f64> =
            (0..4000).flat_map(|_| primitive.sample_manner(&mut rng).values().to_vec()).collect();
        assert!(draws.iter().all(|h| h.abs() <= 1.5));
        // The variance of a standard normal cut off at 1.5: 1 - 3 phi(1.5) / (2 Phi(1.5) - 1).
        let variance = draws.iter().map(|h| h * h).sum::<f64>() / draws.len() as f64;
        assert!((variance - 0.5513).abs() < 0.02, "{variance}");
    }

    #[test]
    fn with_margins_the_ends_of_a_sequence_show_nowhere() {
        // Without the phase every step is the same, but for the zeros beyond the ends.
        let steady = |margins: bool| {
            let mut config = small(Activation::Gelu, true);
            config.network.margins = margins;
            config.steps += 2 * config.margin();
            let mut weights = weights(&config, 1);
            weights.get_mut("decoder.layers.0.weight").unwrap().values.fill(0.0);
            let normalizer = Units::fit(&config, &demonstrations(50, config.steps, 1)).normalizer;
            let manner = MannerSpace::unnamed(3, 3.0);
            let primitive =
                TcVaePrimitive::new(&config, &normalizer, &weights, space(), manner).unwrap();
            let w = TaskParameters::new(&space(), vec![0.5, -0.5, 0.2, 0.1]).unwrap();
            let Generated { mean, stddev, .. } = primitive.generate(&w);
            assert_eq!((mean.steps(), stddev.steps(), primitive.steps()), (12, 12, 12));
            let first = mean.state(0).to_vec();
            mean.states().all(|s| s.iter().zip(&first).all(|(a, b)| (a - b).abs() < 1e-6))
        };
        assert!(steady(true));
        assert!(!steady(false));
    }

    #[test]
    fn a_task_far_away_decodes_to_finite_states() {
        let primitive = primitive(3.0);
        let w = TaskParameters::new(&space(), vec![1e300, -1e300, 1e9, 0.0]).unwrap();
        assert!(primitive.generate(&w).mean.values().iter().all(|v| v.is_finite()));
    }

    #[test]
    fn a_prior_that_leads_beyond_all_numbers_is_refused() {
        let mut config = small(Activation::Gelu, true);
        config.network.prior_components = 1;
        let units = Units::fit(&config, &demonstrations(50, config.steps, 1));
        let build = |deviation: f32| {
            let mut weights = weights(&config, 1);
            let mut add = |name: &str, shape: &[usize], values: Vec<f32>| {
                weights.insert(name.into(), NamedTensor { shape: shape.to_vec(), values });
            };
            add("prior.weights", &[1], vec![1.0]);
            add("prior.means", &[1, 3], vec![0.0; 3]);
            let identity = (0..9).map(|i| if i % 4 == 0 { 1.0 } else { 0.0 });
            let factor = identity.map(|v: f32| v * deviation).collect();
            add("prior.factors", &[1, 3, 3], factor);
            let manner = MannerSpace::unnamed(3, 3.0);
            TcVaePrimitive::new(&config, &units.normalizer, &weights, space(), manner)
        };
        assert!(build(1.0).is_ok());
        // The median of its samples is 0, where the decoder is fine.
        assert!(matches!(build(3e38), Err(ModelError::NotFinite)));
    }

    #[test]
    fn a_space_of_another_size_is_refused() {
        let config = small(Activation::Gelu, true);
        let units = Units::fit(&config, &demonstrations(50, config.steps, 1));
        let error = TcVaePrimitive::new(
            &config,
            &units.normalizer,
            &weights(&config, 1),
            space(),
            MannerSpace::unnamed(2, 3.0),
        )
        .unwrap_err();
        assert_eq!(error.to_string(), "the manner space has 2 values where the model has 3");
    }
}
