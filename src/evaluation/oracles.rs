//! Models of arcs whose right scores are known by construction, for the tests.

use std::f64::consts::{FRAC_PI_2, PI};

use rand::{Rng, RngExt};
use rand_distr::StandardNormal;

use crate::demonstrations::Demonstration;
use crate::demonstrations::arcs::{Arc, ArcsTask, fit_circle};
use crate::demonstrations::task::Task;
use crate::model::{Posterior, Recognition};
use crate::parameters::{MannerParameters, MannerSpace, TaskParameters, TaskSpace};
use crate::primitive::{Generated, MannerConditioned, MovementPrimitive};

/// A model that draws the arc `decode` names, and infers the manner that `recognise` says.
#[derive(Debug)]
pub(crate) struct Oracle {
    task_space: TaskSpace,
    manner_space: MannerSpace,
    decode: fn(&[f64], &[f64]) -> Arc,
    recognise: fn(&Arc) -> Vec<f64>,
    log_variance: f64,
}

impl Oracle {
    /// An oracle with three latents whose posteriors all have this log-variance.
    pub(crate) fn new(
        decode: fn(&[f64], &[f64]) -> Arc,
        recognise: fn(&Arc) -> Vec<f64>,
        log_variance: f64,
    ) -> Self {
        let manner_space = MannerSpace::unnamed(3, 3.0);
        Self { task_space: ArcsTask::task_space(), manner_space, decode, recognise, log_variance }
    }

    /// Right in everything: `h` is radius, span and start, three standard deviations from the
    /// middle of the data to its ends.
    pub(crate) fn exact() -> Self {
        Self::new(exact_arc, exact_manner, -8.0)
    }
}

/// The arc of which [`exact_manner`] is the manner.
pub(crate) fn exact_arc(w: &[f64], h: &[f64]) -> Arc {
    Arc {
        center: [w[0], w[1]],
        radius: 0.35 + 0.05 * h[0],
        span_rad: PI + FRAC_PI_2 / 3.0 * h[1],
        start_rad: FRAC_PI_2 - FRAC_PI_2 / 3.0 * h[2],
    }
}

pub(crate) fn exact_manner(arc: &Arc) -> Vec<f64> {
    vec![
        (arc.radius - 0.35) / 0.05,
        (arc.span_rad - PI) / (FRAC_PI_2 / 3.0),
        (FRAC_PI_2 - arc.start_rad) / (FRAC_PI_2 / 3.0),
    ]
}

impl MovementPrimitive for Oracle {
    fn task_space(&self) -> &TaskSpace {
        &self.task_space
    }

    fn steps(&self) -> usize {
        32
    }

    fn state_dim(&self) -> usize {
        2
    }

    fn generate(&self, w: &TaskParameters) -> Generated {
        self.decode(w, &MannerParameters::mean(&self.manner_space))
    }
}

impl MannerConditioned for Oracle {
    fn manner_space(&self) -> &MannerSpace {
        &self.manner_space
    }

    fn decode(&self, w: &TaskParameters, h: &MannerParameters) -> Generated {
        let mean = (self.decode)(w.values(), h.values()).motion(self.steps()).states;
        Generated { stddev: mean.clone(), mean, duration_secs: None }
    }

    fn sample_manner(&self, rng: &mut dyn Rng) -> MannerParameters {
        let mut value = || loop {
            let value: f64 = rng.sample(StandardNormal);
            if value.abs() <= 3.0 {
                return value;
            }
        };
        let values = (0..3).map(|_| value()).collect();
        MannerParameters::new(&self.manner_space, values).unwrap()
    }
}

impl Recognition for Oracle {
    fn recognise(&self, demonstrations: &[Demonstration]) -> Vec<Posterior> {
        let posterior = |demonstration: &Demonstration| {
            let points: Vec<[f64; 2]> =
                demonstration.motion.states.states().map(|s| [s[0], s[1]]).collect();
            let factors = ArcsTask::default().factors(&demonstration.motion);
            let arc = Arc {
                center: fit_circle(&points).unwrap().center,
                radius: factors[0].value,
                span_rad: factors[1].value,
                start_rad: factors[2].value,
            };
            Posterior { mean: (self.recognise)(&arc), log_variance: vec![self.log_variance; 3] }
        };
        demonstrations.iter().map(posterior).collect()
    }
}
