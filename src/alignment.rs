//! Motions on a common clock: our variant's phase, in which the events of a task, such as the start
//! and the end of a pour, happen at the same place in every motion. The paper's phase is a share of
//! the time.
//!
//! Between `n` events lie `n + 1` segments. In the aligned phase each has the same length; how long
//! it takes in truth is data of its own. The clock between the two is a monotone cubic (Fritsch and
//! Carlson, 1980), so that speeds do not jump where segments meet.

use crate::trajectory::{Motion, Trajectory};

/// Shortest segment as a share of the motion, so that no speed is infinite.
const SHORTEST_SHARE: f64 = 1e-3;
/// Steps in which the phase of a time is found at most, and the last one: the rounding of an f64.
const MOST_STEPS: usize = 60;
const CLOSE: f64 = 1e-16;

/// How the phase of a motion runs with time.
#[derive(Debug, Clone, PartialEq)]
pub struct Alignment {
    /// Time at the ends of the segments, from 0 to 1: shares of the duration.
    times: Vec<f64>,
    /// Change of time with phase there.
    slopes: Vec<f64>,
}

impl Alignment {
    /// The clock of a motion whose segments take these times, in any unit.
    ///
    /// # Panics
    /// When there is no segment, or one does not take a finite time above 0.
    pub fn new(segments: &[f64]) -> Self {
        assert!(
            !segments.is_empty() && segments.iter().all(|s| s.is_finite() && *s > 0.0),
            "segments take finite times above 0: {segments:?}"
        );
        let shares = |segments: &[f64]| {
            let total: f64 = segments.iter().sum();
            segments.iter().map(|s| s / total).collect::<Vec<_>>()
        };
        let bounded: Vec<f64> = shares(segments).iter().map(|s| s.max(SHORTEST_SHARE)).collect();
        let shares = shares(&bounded);
        let mut times = vec![0.0];
        times.extend(shares.iter().scan(0.0, |time, share| {
            *time += share;
            Some(*time)
        }));
        times[segments.len()] = 1.0;
        // The harmonic mean of the neighbouring slopes keeps the cubic monotone.
        let n = segments.len() as f64;
        let mut slopes = vec![n * shares[0]];
        slopes.extend(shares.windows(2).map(|s| n * 2.0 * s[0] * s[1] / (s[0] + s[1])));
        slopes.push(n * shares[segments.len() - 1]);
        Self { times, slopes }
    }

    /// The clock of a motion with events at these shares of its time, ascending inside (0, 1).
    pub fn of_events(events: &[f64]) -> Self {
        let bounds: Vec<f64> = [&[0.0], events, &[1.0]].concat();
        Self::new(&bounds.windows(2).map(|b| b[1] - b[0]).collect::<Vec<_>>())
    }

    /// The share of the time at an aligned phase in [0, 1].
    pub fn time(&self, phase: f64) -> f64 {
        let segments = self.times.len() - 1;
        let at = phase.clamp(0.0, 1.0) * segments as f64;
        let i = (at as usize).min(segments - 1);
        self.time_in(i, at - i as f64).0
    }

    /// The time at a share of a segment's phase, and how it changes with that.
    fn time_in(&self, i: usize, u: f64) -> (f64, f64) {
        let segments = (self.times.len() - 1) as f64;
        // Cubic Hermite; slopes are per phase, and a segment is 1 / segments of it.
        let [a, b] = [self.times[i], self.times[i + 1]];
        let [da, db] = [self.slopes[i], self.slopes[i + 1]].map(|d| d / segments);
        let (v, uu) = (1.0 - u, u * u);
        let time =
            (1.0 + 2.0 * u) * v * v * a + u * v * v * da + uu * (3.0 - 2.0 * u) * b - uu * v * db;
        let slope = 6.0 * u * v * (b - a) + v * (1.0 - 3.0 * u) * da + u * (3.0 * u - 2.0) * db;
        (time, slope)
    }

    /// The aligned phase at a share of the time in [0, 1].
    pub fn phase(&self, time: f64) -> f64 {
        let segments = self.times.len() - 1;
        let i = self.times[1..segments].partition_point(|end| *end <= time);
        // Newton's steps, halving where one would leave what is left of the segment.
        let [mut low, mut high] = [0.0, 1.0];
        let mut u = ((time - self.times[i]) / (self.times[i + 1] - self.times[i])).clamp(0.0, 1.0);
        for _ in 0..MOST_STEPS {
            let (there, slope) = self.time_in(i, u);
            let miss = time - there;
            *(if miss > 0.0 { &mut low } else { &mut high }) = u;
            let newton = u + miss / slope;
            let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
            if (next - u).abs() < CLOSE {
                u = next;
                break;
            }
            u = next;
        }
        (i as f64 + u) / segments as f64
    }

    /// The states of a motion, which are equally spaced in time, at equally spaced phases.
    pub fn aligned(&self, states: &Trajectory, steps: usize) -> Trajectory {
        states.at(equally_spaced(steps).map(|phase| self.time(phase)))
    }

    /// States at equally spaced phases as states that are equally spaced in time.
    pub fn in_time(&self, aligned: &Trajectory) -> Trajectory {
        aligned.at(equally_spaced(aligned.steps()).map(|time| self.phase(time)))
    }
}

/// Times of the segments of a motion with events at these shares of its time (s).
pub fn segment_secs(motion: &Motion, events: &[f64]) -> Vec<f64> {
    let bounds: Vec<f64> = [&[0.0], events, &[1.0]].concat();
    let share = |b: &[f64]| (b[1] - b[0]).max(SHORTEST_SHARE);
    bounds.windows(2).map(|b| share(b) * motion.duration_secs).collect()
}

fn equally_spaced(steps: usize) -> impl Iterator<Item = f64> {
    (0..steps).map(move |i| i as f64 / (steps - 1) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn without_events_the_phase_is_the_time() {
        let clock = Alignment::of_events(&[]);
        for time in [0.0, 0.3, 1.0] {
            assert!((clock.time(time) - time).abs() < 1e-15);
            assert!((clock.phase(time) - time).abs() < 1e-15);
        }
    }

    #[test]
    fn an_event_is_met_at_its_phase_and_its_time() {
        // A bump that is over 1 between the times 0.5 and 0.8.
        let level = |t: f64| 1.0 - ((t - 0.65) / 0.15).powi(2);
        let states = (0..401).map(|i| level(f64::from(i) / 400.0)).collect();
        let states = Trajectory::new(1, states).unwrap();
        let clock = Alignment::of_events(&[0.5, 0.8]);
        let aligned = clock.aligned(&states, 301);
        assert!(aligned.state(100)[0].abs() < 1e-4 && aligned.state(200)[0].abs() < 1e-4);
        let back = clock.in_time(&aligned);
        for (i, state) in back.states().enumerate() {
            let expected = level(i as f64 / 300.0);
            assert!((state[0] - expected).abs() < 2e-3, "{i} {} {expected}", state[0]);
        }
    }

    proptest! {
        #[test]
        fn time_and_phase_are_inverse_and_increase(
            segments in prop::collection::vec(0.01..10.0f64, 1..6), at in 0.0..1.0f64,
        ) {
            let clock = Alignment::new(&segments);
            prop_assert!((clock.phase(clock.time(at)) - at).abs() < 1e-9);
            prop_assert!(clock.time(at + 1e-3) > clock.time(at) || at > 0.999);
            let total: f64 = segments.iter().sum();
            let events = (1..segments.len()).map(|i| segments[..i].iter().sum::<f64>() / total);
            for (i, event) in events.enumerate() {
                let phase = (i + 1) as f64 / segments.len() as f64;
                prop_assert!((clock.time(phase) - event).abs() < 3e-3 * segments.len() as f64);
            }
        }

        #[test]
        fn speeds_do_not_jump_where_segments_meet(a in 0.1..1.0f64, b in 0.1..1.0f64) {
            let clock = Alignment::new(&[a, b]);
            let slope = |from: f64, to: f64| (clock.time(to) - clock.time(from)) / (to - from);
            let (before, after) = (slope(0.5 - 1e-6, 0.5), slope(0.5, 0.5 + 1e-6));
            prop_assert!((before - after).abs() < 1e-4, "{before} {after}");
        }
    }
}
