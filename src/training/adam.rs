//! Adam on flat parameters.
//!
//! Our own, because a resumed training must continue bit for bit: the whole state is three flat
//! vectors and a count that a checkpoint stores, whatever the backend.

/// Decay of the mean of the gradients.
const BETA_1: f64 = 0.9;
/// Decay of the mean of their squares.
const BETA_2: f64 = 0.999;
/// Keeps the step finite where gradients vanish.
const EPSILON: f32 = 1e-8;

/// Parameters with their running moments (Kingma and Ba, *Adam*, 2015).
#[derive(Debug, Clone, PartialEq)]
pub struct Adam {
    /// The parameters.
    pub values: Vec<f32>,
    /// Running mean of the gradients.
    pub first: Vec<f32>,
    /// Running mean of their squares.
    pub second: Vec<f32>,
    /// Steps that were taken.
    pub steps: u64,
}

impl Adam {
    /// Before the first step.
    pub fn new(values: Vec<f32>) -> Self {
        let zeros = vec![0.0; values.len()];
        Self { values, first: zeros.clone(), second: zeros, steps: 0 }
    }

    /// One step down `gradient`.
    ///
    /// # Panics
    /// When the gradient has another length than the parameters.
    pub fn step(&mut self, gradient: &[f32], learning_rate: f64) {
        assert_eq!(gradient.len(), self.values.len(), "a gradient for every parameter");
        self.steps += 1;
        let correction = |beta: f64| 1.0 - beta.powf(self.steps as f64);
        let size = (learning_rate / correction(BETA_1)) as f32;
        let root = correction(BETA_2).sqrt() as f32;
        let (keep_1, keep_2) = (BETA_1 as f32, BETA_2 as f32);
        let (take_1, take_2) = ((1.0 - BETA_1) as f32, (1.0 - BETA_2) as f32);
        let moments = self.first.iter_mut().zip(&mut self.second);
        for ((value, (first, second)), g) in self.values.iter_mut().zip(moments).zip(gradient) {
            *first = keep_1 * *first + take_1 * g;
            *second = keep_2 * *second + take_2 * g * g;
            *value -= size * *first / (second.sqrt() / root + EPSILON);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_step_is_the_learning_rate_whatever_the_gradient() {
        let mut adam = Adam::new(vec![1.0, 1.0, 1.0]);
        adam.step(&[1e-3, -50.0, 0.0], 0.01);
        assert!((adam.values[0] - 0.99).abs() < 1e-6);
        assert!((adam.values[1] - 1.01).abs() < 1e-6);
        assert_eq!(adam.values[2], 1.0);
    }

    #[test]
    fn it_finds_the_foot_of_a_bowl() {
        let mut adam = Adam::new(vec![3.0, -2.0]);
        for _ in 0..2000 {
            let gradient: Vec<f32> = adam.values.iter().map(|x| 2.0 * (x - 1.0)).collect();
            adam.step(&gradient, 0.01);
        }
        assert!(adam.values.iter().all(|x| (x - 1.0).abs() < 1e-3), "{:?}", adam.values);
    }
}
