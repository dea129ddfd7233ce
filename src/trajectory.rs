//! Trajectories over phase, as the model sees them, and over time, as a robot follows them.

use nalgebra::Isometry3;

/// Why values are not a trajectory.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TrajectoryError {
    /// Fewer than two steps.
    #[error("a trajectory needs at least 2 steps; this one has {steps}")]
    TooShort {
        /// Steps that it has.
        steps: usize,
    },
    /// The number of values is not a multiple of the dimension.
    #[error("{values} values are not a whole number of states of {dim} values")]
    Ragged {
        /// Number of values.
        values: usize,
        /// Values of one state.
        dim: usize,
    },
    /// A value is NaN or infinite.
    #[error("value {dim} of step {step} is {value}; a finite number is needed")]
    NotFinite {
        /// Step of the value.
        step: usize,
        /// Place of the value in its state.
        dim: usize,
        /// The value.
        value: f64,
    },
}

/// States at equal steps of phase, shape `[steps, dim]`, in the unit of the state.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    dim: usize,
    values: Vec<f64>,
}

impl Trajectory {
    /// States of `dim` values each, one after the other.
    ///
    /// # Errors
    /// Fewer than two states, an incomplete last state, a value that is not finite.
    pub fn new(dim: usize, values: Vec<f64>) -> Result<Self, TrajectoryError> {
        if dim == 0 || !values.len().is_multiple_of(dim) {
            return Err(TrajectoryError::Ragged { values: values.len(), dim });
        }
        if values.len() < 2 * dim {
            return Err(TrajectoryError::TooShort { steps: values.len() / dim });
        }
        if let Some(i) = values.iter().position(|v| !v.is_finite()) {
            let value = values[i];
            return Err(TrajectoryError::NotFinite { step: i / dim, dim: i % dim, value });
        }
        Ok(Self { dim, values })
    }

    /// Number of states, `T`.
    pub fn steps(&self) -> usize {
        self.values.len() / self.dim
    }

    /// Values of one state, `D`.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// The state at step `t`, `dim` values.
    pub fn state(&self, t: usize) -> &[f64] {
        &self.values[t * self.dim..(t + 1) * self.dim]
    }

    /// All states in their order.
    pub fn states(&self) -> impl ExactSizeIterator<Item = &[f64]> {
        self.values.chunks_exact(self.dim)
    }

    /// All values, `[steps, dim]` row by row.
    pub fn values(&self) -> &[f64] {
        &self.values
    }

    /// The same motion in `steps` states at equal steps, interpolated linearly; the first and the
    /// last state stay.
    ///
    /// # Panics
    /// When `steps` is below 2.
    #[must_use]
    pub fn resampled(&self, steps: usize) -> Self {
        assert!(steps >= 2, "a trajectory has at least 2 steps");
        let scale = (self.steps() - 1) as f64 / (steps - 1) as f64;
        let mut values = Vec::with_capacity(steps * self.dim);
        for i in 0..steps {
            let at = i as f64 * scale;
            let t = (at.floor() as usize).min(self.steps() - 2);
            let share = at - t as f64;
            let pair = self.state(t).iter().zip(self.state(t + 1));
            values.extend(pair.map(|(a, b)| a + share * (b - a)));
        }
        Self { dim: self.dim, values }
    }

    /// The states at these shares of the trajectory in [0, 1], interpolated by Catmull-Rom's cubic,
    /// so that speeds do not jump at the states.
    ///
    /// # Panics
    /// When there are fewer than 2 shares.
    #[must_use]
    pub fn at(&self, shares: impl Iterator<Item = f64>) -> Self {
        let last = self.steps() - 1;
        let mut values = Vec::with_capacity(self.values.len());
        for share in shares {
            let at = share.clamp(0.0, 1.0) * last as f64;
            let t = (at.floor() as usize).min(last - 1);
            let u = at - t as f64;
            let [p1, p2] = [self.state(t), self.state(t + 1)];
            for d in 0..self.dim {
                // Beyond the ends the motion goes on straight.
                let before = if t > 0 { self.state(t - 1)[d] } else { 2.0 * p1[d] - p2[d] };
                let after = if t + 2 <= last { self.state(t + 2)[d] } else { 2.0 * p2[d] - p1[d] };
                let (a, b) = (0.5 * (p2[d] - before), 0.5 * (after - p1[d]));
                let rise = p2[d] - p1[d];
                let cubic = u * (a + u * (3.0 * rise - 2.0 * a - b + u * (a + b - 2.0 * rise)));
                values.push(p1[d] + cubic);
            }
        }
        assert!(values.len() >= 2 * self.dim, "a trajectory has at least 2 steps");
        Self { dim: self.dim, values }
    }

    /// The same motion with `count` states more at either end. They continue it: each is the point
    /// reflection of an inner state at the end state, so that neither place nor speed jumps.
    #[must_use]
    pub fn extended(&self, count: usize) -> Self {
        let last = self.steps() - 1;
        let reflected = |end: usize, inner: usize| {
            let pair = self.state(end).iter().zip(self.state(inner));
            pair.map(|(end, inner)| 2.0 * end - inner)
        };
        let mut values = Vec::with_capacity((self.steps() + 2 * count) * self.dim);
        for k in (1..=count).rev() {
            values.extend(reflected(0, k.min(last)));
        }
        values.extend(&self.values);
        for k in 1..=count {
            values.extend(reflected(last, last - k.min(last)));
        }
        Self { dim: self.dim, values }
    }
}

/// A trajectory that takes a time: the states are equally spaced from 0 to `duration_secs`.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    /// The states.
    pub states: Trajectory,
    /// Time from the first state to the last.
    pub duration_secs: f64,
}

impl Motion {
    /// Time between two states.
    pub fn step_secs(&self) -> f64 {
        self.duration_secs / (self.states.steps() - 1) as f64
    }
}

/// End-effector poses in the base frame over time.
#[derive(Debug, Clone, PartialEq)]
pub struct EndEffectorTrajectory {
    /// Time of each pose from the start, strictly increasing.
    pub times_secs: Vec<f64>,
    /// The tip in the base frame.
    pub base_from_tip: Vec<Isometry3<f64>>,
}

/// Joint positions and velocities over time.
#[derive(Debug, Clone, PartialEq)]
pub struct JointTrajectory {
    /// Names of the joints, in the order of the values.
    pub joint_names: Vec<String>,
    /// Time of each point from the start, strictly increasing.
    pub times_secs: Vec<f64>,
    /// One vector per point: rad, or m for prismatic joints.
    pub positions: Vec<Vec<f64>>,
    /// One vector per point: rad/s, or m/s for prismatic joints.
    pub velocities: Vec<Vec<f64>>,
    /// One vector per point: rad/s², or m/s² for prismatic joints.
    pub accelerations: Vec<Vec<f64>>,
}

impl JointTrajectory {
    /// The configuration at a time: on the way between two points, the first before them, and the last after them.
    ///
    /// # Panics
    /// Without points.
    pub fn at(&self, secs: f64) -> Vec<f64> {
        let times = &self.times_secs;
        match times.partition_point(|time| *time <= secs) {
            0 => self.positions[0].clone(),
            after if after == times.len() => self.positions[after - 1].clone(),
            after => {
                let (from, to) = (times[after - 1], times[after]);
                self.between(after - 1, (secs - from) / (to - from))
            }
        }
    }

    /// The configuration at a share of the way in time from point `k` to the next, on the cubic between them.
    ///
    /// # Panics
    /// When there is no point after `k`.
    pub fn between(&self, k: usize, share: f64) -> Vec<f64> {
        let h = self.times_secs[k + 1] - self.times_secs[k];
        let joint = |j: usize| {
            let (from, to) = (self.positions[k][j], self.positions[k + 1][j]);
            let (a, b) = (h * self.velocities[k][j], h * self.velocities[k + 1][j]);
            let (rise, u) = (to - from, share);
            from + u * (a + u * (3.0 * rise - 2.0 * a - b + u * (a + b - 2.0 * rise)))
        };
        (0..self.joint_names.len()).map(joint).collect()
    }

    /// This trajectory, and then another that begins where and when this one ends: its first point takes the
    /// place of this one's last.
    #[must_use]
    pub fn followed_by(mut self, other: Self) -> Self {
        let (Some(end), Some(start)) = (self.times_secs.pop(), other.times_secs.first().copied())
        else {
            return other;
        };
        self.positions.pop();
        self.velocities.pop();
        self.accelerations.pop();
        self.times_secs.extend(other.times_secs.iter().map(|time| end + (time - start)));
        self.positions.extend(other.positions);
        self.velocities.extend(other.velocities);
        self.accelerations.extend(other.accelerations);
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(steps: usize) -> Trajectory {
        let values = (0..steps).flat_map(|i| [i as f64, -2.0 * i as f64]).collect();
        Trajectory::new(2, values).unwrap()
    }

    #[test]
    fn resampling_a_line_keeps_the_line_and_its_ends() {
        let resampled = line(11).resampled(4);
        assert_eq!(resampled.steps(), 4);
        for (i, state) in resampled.states().enumerate() {
            let expected = 10.0 * i as f64 / 3.0;
            assert!((state[0] - expected).abs() < 1e-12);
            assert!((state[1] + 2.0 * expected).abs() < 1e-12);
        }
    }

    #[test]
    fn a_cubic_through_states_keeps_lines_and_parabolas() {
        let shares = [0.0, 0.1, 0.55, 1.0];
        let at = line(5).at(shares.into_iter());
        for (state, share) in at.states().zip(shares) {
            assert!((state[0] - 4.0 * share).abs() < 1e-12, "{state:?}");
        }
        let parabola = Trajectory::new(1, (0..6).map(|i| f64::from(i * i)).collect()).unwrap();
        // Inside, where the neighbours are the parabola's.
        let at = parabola.at([0.3, 0.5].into_iter());
        for (state, x) in at.states().zip([1.5, 2.5_f64]) {
            assert!((state[0] - x * x).abs() < 1e-12, "{state:?}");
        }
    }

    #[test]
    fn extending_a_line_gives_the_longer_line() {
        let extended = line(5).extended(3);
        assert_eq!(extended.steps(), 11);
        for (i, state) in extended.states().enumerate() {
            let expected = i as f64 - 3.0;
            assert_eq!(state, [expected, -2.0 * expected]);
        }
        assert_eq!(line(5).extended(0), line(5));
    }

    #[test]
    fn a_value_that_is_not_finite_is_refused_with_its_place() {
        let error = Trajectory::new(2, vec![0.0, 0.0, 1.0, f64::INFINITY]).unwrap_err();
        assert!(matches!(error, TrajectoryError::NotFinite { step: 1, dim: 1, .. }));
    }

    #[test]
    fn one_state_is_no_trajectory() {
        assert!(matches!(
            Trajectory::new(3, vec![0.0; 3]),
            Err(TrajectoryError::TooShort { steps: 1 })
        ));
    }
}
