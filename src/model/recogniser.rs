//! The recognition network of a trained model, on Burn.

use super::backend::Backend;
use super::config::ModelConfig;
use super::layout::Layout;
use super::networks::{Networks, Parameters, tensor, values};
use super::normalizer::{Normalizer, Units};
use super::{ModelError, Posterior, Recognition, Weights};
use crate::primitive::Demonstration;

/// Demonstrations that are recognised in one pass.
const BATCH: usize = 128;

/// A trained recognition network.
#[derive(Debug, Clone)]
pub struct Recogniser {
    config: ModelConfig,
    units: Units,
    layout: Layout,
    flat: Vec<f32>,
    backend: Backend,
}

impl Recogniser {
    /// The recogniser with these weights.
    ///
    /// # Errors
    /// Anything that does not fit together, as for [`super::TcVaePrimitive::new`].
    pub fn new(
        config: &ModelConfig,
        normalizer: &Normalizer,
        weights: &Weights,
        backend: Backend,
    ) -> Result<Self, ModelError> {
        config.check()?;
        let layout = Layout::of_model(config);
        Ok(Self {
            units: Units::new(config, normalizer, weights)?,
            flat: layout.from_weights(weights)?,
            layout,
            config: config.clone(),
            backend,
        })
    }
}

impl Recognition for Recogniser {
    /// # Panics
    /// When a demonstration has other states or tasks than the model.
    fn recognise(&self, demonstrations: &[Demonstration]) -> Vec<Posterior> {
        let device = self.backend.device();
        let networks = Networks::new(&self.config, self.backend, &device);
        let parameters = Parameters::new(&self.layout, &self.flat, &device);
        let mut posteriors = Vec::with_capacity(demonstrations.len());
        for batch in demonstrations.chunks(BATCH) {
            let x = time_major(&self.config, batch.iter().map(|d| self.normalised(d)).collect());
            let rows = [self.config.steps * batch.len(), self.config.state_dim];
            let w = batch.iter().flat_map(|d| self.units.task(d.w.values())).collect();
            let w = tensor(w, [batch.len(), self.config.task_dim], &device);
            let posterior = networks.recognise(&parameters, tensor(x, rows, &device), &w);
            let (mean, log_variance) = (values(posterior.mean), values(posterior.log_variance));
            let latents = self.config.network.latents;
            let wide = |row: &[f32]| row.iter().copied().map(f64::from).collect();
            let rows = mean.chunks(latents).zip(log_variance.chunks(latents));
            posteriors
                .extend(rows.map(|(m, v)| Posterior { mean: wide(m), log_variance: wide(v) }));
        }
        posteriors
    }
}

impl Recogniser {
    fn normalised(&self, demonstration: &Demonstration) -> Vec<f32> {
        let Demonstration { w, motion, .. } = demonstration;
        assert_eq!(motion.states.dim(), self.config.motion_dim(), "the model's states");
        self.units.states(&self.config.sequence(demonstration), &self.units.task(w.values()))
    }
}

/// Sequences of states, one vector each, as `[steps, sequences, state_dim]`.
pub(crate) fn time_major(config: &ModelConfig, sequences: Vec<Vec<f32>>) -> Vec<f32> {
    let dim = config.state_dim;
    let mut rows = Vec::with_capacity(config.steps * sequences.len() * dim);
    for t in 0..config.steps {
        for sequence in &sequences {
            rows.extend(&sequence[t * dim..(t + 1) * dim]);
        }
    }
    rows
}
