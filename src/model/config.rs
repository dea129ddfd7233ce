//! The shape of a model: what is stored with it, and all that its tensors' shapes follow from.

use serde::{Deserialize, Serialize};

#[cfg(feature = "train")]
use crate::alignment::{Alignment, segment_secs};
#[cfg(feature = "train")]
use crate::pose::to_turns;
use crate::pose::{STATE_DIM, TURN_CONSTANTS, TURN_DIM};
#[cfg(feature = "train")]
use crate::primitive::Demonstration;
#[cfg(feature = "train")]
use crate::trajectory::Trajectory;

/// Nonlinearity of every hidden layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Activation {
    /// `max(x, 0)`, as the paper's networks have it.
    Relu,
    /// `x Phi(x)` with the error function; a deviation from the paper.
    Gelu,
}

/// The parts of the networks that a user chooses.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NetworkConfig {
    /// Number of manner parameters `h`; the paper takes 4.
    pub latents: usize,
    /// Channels of every hidden layer of the recognition network and of the decoder.
    pub width: usize,
    /// Convolutions in each TCN, with dilations 1, 2, 4, …; the paper takes 3.
    pub layers: usize,
    /// Nonlinearity. The paper's is `relu`; `gelu` is a deviation that learns far better.
    pub activation: Activation,
    /// Whether a convolution of equal width in and out adds its input to its output. Not in the
    /// paper.
    pub residual: bool,
    /// Our variant: the networks learn what an affine baseline in `w`, fitted per step before
    /// training, leaves over. The decoder's mean is `A_t w + b_t + f(h, w, tau_t)`, and the
    /// recognition network sees the motion relative to the baseline. Not in the paper.
    pub task_baseline: bool,
    /// Our variant: the networks see and decode a few states beyond either end, which are cut off
    /// again. The zeros that convolutions see beyond a sequence then show in no state that is
    /// served; without, motions jerk in the few steps at the ends. Not in the paper.
    pub margins: bool,
    /// Our variant: motions are aligned by the events of their task, and the networks also see and
    /// decode how long each of the segments between events takes ([`crate::alignment`]): 1 for the
    /// whole motion, 3 for a task with two events. 0 is the paper's phase, in which motions have no
    /// duration and are served at the demonstrations' median.
    pub segments: usize,
    /// Our variant, for states that are poses: the networks see and decode orientations as turns from
    /// the motion's first one, an angle about an axis and what is left over, with the axis and the
    /// first orientation beside them. How far a cup is tilted is then learned apart from which way,
    /// and from where the hand points. Not in the paper.
    pub orientations_as_turns: bool,
    /// Whether the decoder sees w; without, and with 10 latents, it is the paper's VAE.
    pub task_conditioned: bool,
    /// Whether log-variances are bounded, the decoder's softly to [`Self::least_log_variance`, 4] and
    /// the recognition network's to [-10, 4]. Not in the paper.
    pub bounded_variances: bool,
    /// Where the decoder's log-variance is bounded below, in normalised units. Values that follow
    /// from the task almost exactly would else rule the loss, by ever smaller variances.
    pub least_log_variance: f64,
    /// Our variant: components of a mixture that is fitted to the latents of the training set in
    /// place of the paper's N(0, I), see [`super::LearnedPrior`]; 0 keeps N(0, I).
    pub prior_components: usize,
    /// Functions of the phase that the networks see. 1 is the paper's, the phase itself; more are our
    /// variant's, bells at equal distances as a ProMP has them, with which what happens at one time
    /// is learned apart from the rest. They cost nothing at serving time.
    pub phase_functions: usize,
    /// Our variant: the recognition network sees the phase and w beside each state, so that it can
    /// tell when something happens and what of it follows from the task. Not in the paper.
    pub recognition_sees_context: bool,
    /// Parts of equal length that the recognition network averages over. The paper's is 1, the mean
    /// over the whole motion; our variant's MLPs see the mean of each part, and so when something
    /// happens.
    pub recognition_parts: usize,
}

impl NetworkConfig {
    /// Centre and half of the range that the decoder's log-variance is softly bounded to.
    pub(crate) fn log_variance_range(&self) -> (f32, f32) {
        let [low, high] = [self.least_log_variance, MOST_LOG_VARIANCE];
        ((0.5 * (low + high)) as f32, (0.5 * (high - low)) as f32)
    }

    /// Values that the networks see at a step beside those of a state: what a turn has more, and what
    /// is the same at each step.
    pub(crate) fn beside(&self) -> usize {
        let of_turn = if self.orientations_as_turns { TURN_DIM - STATE_DIM } else { 0 };
        of_turn.saturating_add(self.constants())
    }

    /// Values of these that are the same at each step of a motion.
    pub(crate) fn constants(&self) -> usize {
        let of_turns = if self.orientations_as_turns { TURN_CONSTANTS } else { 0 };
        self.segments.saturating_add(of_turns)
    }

    /// Steps of the margin at either end, the sum of the dilations; 0 without margins.
    pub(crate) fn margin(&self) -> usize {
        match self.margins {
            true => (0..self.layers.min(MAX_LAYERS)).map(ModelConfig::dilation).sum(),
            false => 0,
        }
    }
}

impl Default for NetworkConfig {
    fn default() -> Self {
        Self {
            latents: 4,
            width: 32,
            layers: 3,
            activation: Activation::Gelu,
            residual: true,
            task_baseline: false,
            margins: false,
            segments: 0,
            orientations_as_turns: false,
            task_conditioned: true,
            bounded_variances: true,
            least_log_variance: -12.0,
            prior_components: 0,
            phase_functions: 1,
            recognition_sees_context: false,
            recognition_parts: 1,
        }
    }
}

/// All that the shapes of a model's tensors follow from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelConfig {
    /// Steps that the networks see: those of a trajectory, `T`, and the margins.
    pub steps: usize,
    /// Values that the networks see at a step: those of a state, `D`, the seven more of a turn where
    /// orientations are turns, and the logarithm of each segment's duration.
    pub state_dim: usize,
    /// Values of the task parameters `w`.
    pub task_dim: usize,
    /// The networks.
    pub network: NetworkConfig,
}

/// More layers see further than any trajectory is long.
const MAX_LAYERS: usize = 12;

/// Taps of a convolution: the step `dilation` before, the step itself, the step `dilation` after.
pub(crate) const TAPS: usize = 3;

/// Height of the bells over the phase. Start values suit inputs of deviation 1, and of these few are
/// not 0 at a time.
const PHASE_BELL: f32 = 3.0;
/// Upper bound of the decoder's log-variance.
const MOST_LOG_VARIANCE: f64 = 4.0;
/// The decoder's log-variance may not be bounded further below; its exponential stays an f32.
const LEAST_LOG_VARIANCE: f64 = -40.0;

/// Why a configuration is not one.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{name} is {value}; it must lie in [{lower}, {upper}]")]
pub struct ConfigError {
    /// The key.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
    /// Smallest possible value.
    pub lower: f64,
    /// Largest possible value.
    pub upper: f64,
}

impl ModelConfig {
    /// Checks every size.
    ///
    /// # Errors
    /// A size that no model has; the bounds also keep a foreign file from asking for the moon.
    pub fn check(&self) -> Result<(), ConfigError> {
        let NetworkConfig { latents, width, layers, .. } = self.network;
        let least = self.network.least_log_variance;
        if !(LEAST_LOG_VARIANCE..=0.0).contains(&least) {
            let (name, lower, upper) = ("least_log_variance", LEAST_LOG_VARIANCE, 0.0);
            return Err(ConfigError { name, value: least, lower, upper });
        }
        // Turns are those of poses.
        let beside = self.network.beside();
        let (least, most) = match self.network.orientations_as_turns {
            true => (beside.saturating_add(STATE_DIM), beside.saturating_add(STATE_DIM)),
            false => (beside.saturating_add(1), 1000),
        };
        for (name, value, lower, upper) in [
            ("layers", layers, 1, MAX_LAYERS),
            ("steps", self.steps, 2 + 2 * self.margin(), 20_000),
            ("state_dim", self.state_dim, least, most),
            ("task_dim", self.task_dim, 1, 1000),
            ("latents", latents, 1, 1000),
            ("width", width, 1, 10_000),
            ("prior_components", self.network.prior_components, 0, 1000),
            ("phase_functions", self.network.phase_functions, 1, 1000),
            ("recognition_parts", self.network.recognition_parts, 1, self.steps),
        ] {
            if !(lower..=upper).contains(&value) {
                let [value, lower, upper] = [value, lower, upper].map(|v| v as f64);
                return Err(ConfigError { name, value, lower, upper });
            }
        }
        Ok(())
    }

    /// Steps of the margin at either end: as far as the zeros beyond a sequence reach through all
    /// convolutions.
    pub(crate) fn margin(&self) -> usize {
        self.network.margin()
    }

    /// Steps of a motion, `T`.
    pub(crate) fn motion_steps(&self) -> usize {
        self.steps - 2 * self.margin()
    }

    /// Values of a motion's state, `D`.
    pub(crate) fn motion_dim(&self) -> usize {
        self.state_dim - self.network.beside()
    }

    /// A motion as the networks see it: `T` steps and the margins; states, or turns and their constants;
    /// and the segments' durations.
    #[cfg(feature = "train")]
    pub(crate) fn sequence(&self, demonstration: &Demonstration) -> Trajectory {
        let Demonstration { motion, events, .. } = demonstration;
        let states = match self.network.segments {
            0 | 1 if motion.states.steps() == self.motion_steps() => motion.states.clone(),
            0 | 1 => motion.states.resampled(self.motion_steps()),
            _ => Alignment::of_events(events).aligned(&motion.states, self.motion_steps()),
        };
        let (states, mut constants) = match self.network.orientations_as_turns {
            true => {
                let (turns, constants) = to_turns(&states);
                (turns, constants.to_vec())
            }
            false => (states, Vec::new()),
        };
        let extended = states.extended(self.margin());
        if self.network.segments > 0 {
            let events = if self.network.segments == 1 { &[] } else { events.as_slice() };
            constants.extend(segment_secs(motion, events).iter().map(|secs| secs.ln()));
        }
        let values = extended.states().flat_map(|s| s.iter().chain(&constants).copied());
        Trajectory::new(self.state_dim, values.collect())
            .expect("segments take finite times above 0")
    }

    /// Dilation of a layer: 1, 2, 4, …
    pub(crate) fn dilation(layer: usize) -> usize {
        1 << layer
    }

    /// What the networks see of the phase `tau_t = t / T`, `t = 1 … T`, at each step: the phase
    /// itself, or bells over it, `[steps, phase_functions]`.
    pub(crate) fn phase(&self) -> Vec<f32> {
        let count = self.network.phase_functions;
        let phases = (1..=self.steps).map(|t| t as f32 / self.steps as f32);
        if count == 1 {
            return phases.collect();
        }
        let bell = |tau: f32, i: usize| {
            let z = tau * (count - 1) as f32 - i as f32;
            PHASE_BELL * (-0.5 * z * z).exp()
        };
        phases.flat_map(|tau| (0..count).map(move |i| bell(tau, i))).collect()
    }

    /// Values that are constant along a sequence and enter the decoder's first convolution: the
    /// code of h, the code of w, and h itself.
    pub(crate) fn first_constants(&self) -> usize {
        2 * self.network.width + self.network.latents
    }
}

#[cfg(all(test, feature = "train"))]
mod tests {
    use super::*;
    use crate::model::layout::tests::small;
    use crate::model::normalizer::tests::space;
    use crate::parameters::TaskParameters;
    use crate::trajectory::Motion;

    /// A hand that turns about its z, whatever it points to, and back by half.
    fn demonstration(first: [f64; 3]) -> Demonstration {
        let base = crate::pose::StateFrame { reference: nalgebra::UnitQuaternion::identity() };
        let first = nalgebra::UnitQuaternion::from_scaled_axis(first.into());
        let pose = |i: usize| {
            let angle = 1.5 - (0.15 * i as f64 - 1.5).abs();
            let turn =
                nalgebra::UnitQuaternion::from_axis_angle(&nalgebra::Vector3::z_axis(), angle);
            nalgebra::Isometry3::from_parts([0.1 * i as f64, 0.2, 0.3].into(), first * turn)
        };
        let states = base.trajectory(&(0..16).map(pose).collect::<Vec<_>>());
        Demonstration {
            id: "1".into(),
            w: TaskParameters::new(&space(), vec![0.0; 4]).expect("inside"),
            motion: Motion { states, duration_secs: 3.0 },
            events: vec![0.25],
        }
    }

    fn with_turns() -> ModelConfig {
        let mut config = small(Activation::Gelu, true);
        (config.network.orientations_as_turns, config.network.segments) = (true, 2);
        (config.steps, config.state_dim) = (16, 6 + 1 + 6 + 2);
        config
    }

    #[test]
    fn a_turn_looks_the_same_wherever_the_hand_points() {
        let config = with_turns();
        config.check().unwrap();
        let [a, b] =
            [[0.0, 0.0, 0.0], [0.3, -0.8, 0.5]].map(|first| config.sequence(&demonstration(first)));
        // Between two steps the rotation vectors of the two go different ways.
        const NEAR: f64 = 2e-3;
        for (a, b) in a.states().zip(b.states()) {
            // Position, what the angle leaves over, angle and axis are equal, and so are durations.
            for i in (0..10).chain(13..15) {
                assert!((a[i] - b[i]).abs() < NEAR, "{i}: {a:?} {b:?}");
            }
            assert!((a[7..10].iter().zip([0.0, 0.0, 1.0])).all(|(v, e)| (v - e).abs() < NEAR));
            assert!((b[10..13].iter().zip([0.3, -0.8, 0.5])).all(|(v, e)| (v - e).abs() < NEAR));
            let secs = [a[13].exp(), a[14].exp()];
            assert!((secs[0] - 0.75).abs() < 1e-9 && (secs[1] - 2.25).abs() < 1e-9, "{secs:?}");
        }
    }

    #[test]
    fn only_poses_turn() {
        let mut config = with_turns();
        config.state_dim = 2 + 1 + 6 + 2;
        let error = config.check().unwrap_err();
        assert_eq!(error.to_string(), "state_dim is 11; it must lie in [15, 15]");
        config.network.segments = usize::MAX;
        assert!(config.check().is_err());
    }
}
