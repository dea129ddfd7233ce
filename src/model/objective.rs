//! What training minimises: the beta-ELBO (eq. 5), the adversary's loss (eq. 13) and their
//! alternation (eq. 14).

use burn::tensor::{Device, Tensor};

use super::config::ModelConfig;
use super::layout::Layout;
use super::networks::{Networks, Parameters, tensor, values};

/// A part of a batch, in the network's normalised units.
#[derive(Debug, Clone, PartialEq)]
pub struct Batch {
    /// Number of sequences.
    pub sequences: usize,
    /// The motions, `[steps, sequences, state_dim]`.
    pub x: Vec<f32>,
    /// The tasks, `[sequences, task_dim]`.
    pub w: Vec<f32>,
    /// Standard normal draws for the reparametrised sample of h, `[sequences, latents]`.
    pub noise: Vec<f32>,
    /// Our variant's anchors: standard scores that the first latents' posterior means are drawn
    /// to, `[sequences, anchors]`; empty without.
    pub anchors: Vec<f32>,
}

/// Strengths of the terms at one step of training.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Strengths {
    /// Factor of the KL divergence.
    pub beta: f32,
    /// Factor of the adversary's loss in the model's objective.
    pub alpha: f32,
    /// Factor of half the squared distance between posterior means and their anchors.
    pub gamma: f32,
}

/// The terms of the objective, summed over the sequences of a batch.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Terms {
    /// Number of sequences.
    pub sequences: usize,
    /// Negative log-likelihood of the motions (nat), with the factors of its channels.
    pub negative_log_likelihood: f64,
    /// KL divergence of each latent from the prior (nat).
    pub kl: Vec<f64>,
    /// L1 distance of the adversary's guess from w, in normalised units.
    pub adversary: f64,
    /// Squared distance of each anchored latent's posterior means from its anchors.
    pub anchors: Vec<f64>,
}

impl Terms {
    /// Adds the sums of `other`.
    pub fn add(&mut self, other: &Self) {
        self.sequences += other.sequences;
        self.negative_log_likelihood += other.negative_log_likelihood;
        self.adversary += other.adversary;
        for (sums, more) in [(&mut self.kl, &other.kl), (&mut self.anchors, &other.anchors)] {
            sums.resize(sums.len().max(more.len()), 0.0);
            sums.iter_mut().zip(more).for_each(|(a, b)| *a += b);
        }
    }
}

/// Gradients of one part of a batch, in the order of the layouts.
#[derive(Debug, Clone, PartialEq)]
pub struct PartGradients {
    /// Of the model's objective, by the model's parameters.
    pub model: Vec<f32>,
    /// Of the adversary's objective, by the adversary's parameters.
    pub adversary: Vec<f32>,
    /// The terms.
    pub terms: Terms,
}

/// The objective of one model on one device.
#[derive(Debug, Clone)]
pub struct Objective {
    networks: Networks,
    backend: super::Backend,
    device: Device,
    model: Layout,
    adversary: Layout,
    /// Factor of each channel's likelihood, where not all are 1.
    likelihood: Option<Vec<f32>>,
}

impl Objective {
    /// The objective with an adversary of the given width.
    pub fn new(config: &ModelConfig, adversary_width: usize, backend: super::Backend) -> Self {
        let device = backend.device().autodiff();
        Self {
            networks: Networks::new(config, backend, &device),
            backend,
            device,
            model: Layout::of_model(config),
            adversary: Layout::of_adversary(config, adversary_width),
            likelihood: None,
        }
    }

    /// The objective in which the likelihood of values that are the same at each step of a motion has
    /// this factor.
    pub fn with_constants(mut self, factor: f32) -> Self {
        let ModelConfig { state_dim, network, .. } = &self.networks.config;
        let constants = network.constants();
        if constants > 0 && factor != 1.0 {
            let mut factors = vec![1.0; state_dim - constants];
            factors.resize(*state_dim, factor);
            self.likelihood = Some(factors);
        }
        self
    }

    /// Terms and gradients of both players on a part of a batch of `batch_size` sequences: the
    /// model minimises `(NLL + beta KL - alpha L1 + gamma A / 2) / (T D)`, the adversary `L1`, each
    /// meant over the batch; `A` is the squared distance from the anchors. The parts' gradients add up
    /// to those of the batch.
    ///
    /// The division by `T D` is for the optimiser's sake only. The adversary sees the posterior
    /// means; its own step does not reach the recognition network.
    ///
    /// # Panics
    /// When the sizes of `part` or of the parameters are not the configuration's.
    pub fn gradients(
        &self,
        model: &[f32],
        adversary: &[f32],
        part: &Batch,
        batch_size: usize,
        strengths: Strengths,
    ) -> PartGradients {
        let ModelConfig { steps, state_dim, .. } = self.networks.config;
        let model = Parameters::new(&self.model, model, &self.device);
        let players = self.forward(&model, adversary, part);
        let objective = players.negative_log_likelihood.clone()
            + players.kl.clone().sum().mul_scalar(strengths.beta)
            - players.adversary.clone().mul_scalar(strengths.alpha)
            + match &players.anchors {
                Some(anchors) => anchors.clone().sum().mul_scalar(0.5 * strengths.gamma),
                None => Tensor::zeros([1], &self.device),
            };
        let scale = 1.0 / (batch_size * steps * state_dim) as f32;
        let mut gradients = objective.mul_scalar(scale).backward();
        let model = model.gradients(&mut gradients);
        let terms = players.terms(part.sequences);

        let trained = Parameters::new(&self.adversary, adversary, &self.device);
        let means = Tensor::from_inner(players.means.inner());
        let l1 = self.l1(&trained, means, part).mul_scalar(1.0 / batch_size as f32);
        let adversary = trained.gradients(&mut l1.backward());
        PartGradients { model, adversary, terms }
    }

    /// The terms alone, without gradients.
    pub fn terms(&self, model: &[f32], adversary: &[f32], part: &Batch) -> Terms {
        let device = self.device.clone().inner();
        let networks = Networks::new(&self.networks.config, self.backend, &device);
        let plain = Self { networks, device, ..self.clone() };
        let model = Parameters::new(&plain.model, model, &plain.device);
        plain.forward(&model, adversary, part).terms(part.sequences)
    }

    fn forward(&self, model: &Parameters<'_>, adversary: &[f32], part: &Batch) -> Players {
        let ModelConfig { steps, state_dim, task_dim, network } = &self.networks.config;
        let n = part.sequences;
        let x = tensor(part.x.clone(), [steps * n, *state_dim], &self.device);
        let w = tensor(part.w.clone(), [n, *task_dim], &self.device);
        let noise = tensor(part.noise.clone(), [n, network.latents], &self.device);

        let posterior = self.networks.recognise(model, x.clone(), &w);
        let (mean, log_variance) = (posterior.mean, posterior.log_variance);
        let h = mean.clone() + noise * log_variance.clone().mul_scalar(0.5).exp();
        let decoded = self.networks.decode(model, h, w);
        let squared = (x - decoded.mean).square();
        let nll = squared * decoded.log_variance.clone().neg().exp() + decoded.log_variance;
        let (nll, channels) = match &self.likelihood {
            Some(factors) => {
                let channels = factors.iter().sum();
                (nll * tensor(factors.clone(), [1, *state_dim], &self.device), channels)
            }
            None => (nll, *state_dim as f32),
        };
        let constant = (steps * n) as f32 * channels * std::f32::consts::TAU.ln();
        let kl = mean.clone().square() + log_variance.clone().exp() - log_variance - 1.0;

        // The model's step sees the adversary as it is: its parameters are constants here.
        let fixed = Parameters::new(&self.adversary, adversary, &self.device.clone().inner());
        Players {
            negative_log_likelihood: nll.sum().add_scalar(constant).mul_scalar(0.5),
            kl: kl.sum_dim(0).mul_scalar(0.5),
            adversary: self.l1(&fixed, mean.clone(), part),
            anchors: self.anchored(mean.clone(), part),
            means: mean,
        }
    }

    /// The squared distance from each anchor over a part, `[1, anchors]`; none without anchors.
    fn anchored(&self, means: Tensor<2>, part: &Batch) -> Option<Tensor<2>> {
        let n = part.sequences;
        let count = part.anchors.len() / n;
        (count > 0).then(|| {
            let anchors = tensor(part.anchors.clone(), [n, count], &self.device);
            (means.slice([0..n, 0..count]) - anchors).square().sum_dim(0)
        })
    }

    /// `sum |f_W(h) - w|` over a part.
    fn l1(&self, adversary: &Parameters<'_>, h: Tensor<2>, part: &Batch) -> Tensor<1> {
        let task_dim = self.networks.config.task_dim;
        let w = tensor(part.w.clone(), [part.sequences, task_dim], &self.device);
        (self.networks.guess_task(adversary, h) - w).abs().sum()
    }
}

/// The terms as tensors.
struct Players {
    negative_log_likelihood: Tensor<1>,
    /// One column for each latent.
    kl: Tensor<2>,
    adversary: Tensor<1>,
    anchors: Option<Tensor<2>>,
    /// The posterior means.
    means: Tensor<2>,
}

impl Players {
    fn terms(&self, sequences: usize) -> Terms {
        let scalar = |x: &Tensor<1>| f64::from(values(x.clone().inner())[0]);
        let row = |x: &Tensor<2>| values(x.clone().inner()).into_iter().map(f64::from).collect();
        Terms {
            sequences,
            negative_log_likelihood: scalar(&self.negative_log_likelihood),
            kl: row(&self.kl),
            adversary: scalar(&self.adversary),
            anchors: self.anchors.as_ref().map(row).unwrap_or_default(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Backend;
    use super::super::config::Activation;
    use super::super::layout::tests::small;
    use super::*;
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    #[test]
    fn the_likelihood_of_constants_counts_by_its_factor() {
        let mut config = small(Activation::Gelu, true);
        (config.network.segments, config.state_dim) = (1, 3);
        let start = |layout: Layout| layout.initial(&mut ChaCha8Rng::seed_from_u64(1));
        let model = start(Layout::of_model(&config));
        let adversary = start(Layout::of_adversary(&config, 8));
        let ramp = |n: usize| (0..n).map(|i| (i % 7) as f32 / 3.0 - 1.0).collect::<Vec<_>>();
        let batch = Batch {
            sequences: 2,
            x: ramp(2 * config.steps * 3),
            w: ramp(2 * 4),
            noise: ramp(2 * 3),
            anchors: Vec::new(),
        };
        let likelihood = |factor: f32| {
            let objective = Objective::new(&config, 8, Backend::default()).with_constants(factor);
            objective.terms(&model, &adversary, &batch).negative_log_likelihood
        };
        let [none, half, all] = [0.0, 0.5, 1.0].map(likelihood);
        assert!((none - all).abs() > 1.0, "{none} {all}");
        assert!((half - 0.5 * (none + all)).abs() < 1e-3, "{none} {half} {all}");
    }
}
