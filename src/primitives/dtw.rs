//! Dynamic time warping (H. Sakoe and S. Chiba, *Dynamic Programming Algorithm Optimization for
//! Spoken Word Recognition*, 1978): which state of one trajectory belongs to which of another.
//!
//! The local cost is the Euclidean distance of the states. Both ends are matched, and each step of
//! the path goes on by one state in one of the trajectories, or in both.

use crate::trajectory::Trajectory;

/// What the steps of a path cost, in the names of the R and Python packages `dtw`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum StepPattern {
    /// Every step costs the local cost at its end. Prefers diagonals.
    Symmetric1,
    /// A diagonal step costs twice the local cost at its end, so that a path's weight is the sum of
    /// both lengths whatever way it takes.
    #[default]
    Symmetric2,
}

/// The cheapest path.
#[derive(Debug, Clone, PartialEq)]
pub struct Warping {
    /// The path's cost; not normalized. [`StepPattern::Symmetric2`] divided by the sum of both
    /// lengths compares between trajectories of other lengths.
    pub distance: f64,
    /// Pairs of a step of the query and the step of the reference that it belongs to, from both
    /// first steps to both last ones.
    pub path: Vec<(usize, usize)>,
}

/// The cheapest path between `query` and `reference`. Of equally cheap ways a diagonal is taken
/// first, then one in the reference, then one in the query. `window` is the largest number of steps
/// that the steps of a pair may lie apart (Sakoe and Chiba's band), if there is a limit.
///
/// # Panics
/// When the trajectories' states have other numbers of values, or their lengths differ by more than
/// the window.
pub fn warp(
    query: &Trajectory,
    reference: &Trajectory,
    pattern: StepPattern,
    window: Option<usize>,
) -> Warping {
    assert_eq!(query.dim(), reference.dim(), "states of the same values");
    let (rows, columns) = (query.steps(), reference.steps());
    let outside = |i: usize, j: usize| window.is_some_and(|window| i.abs_diff(j) > window);
    assert!(!outside(rows, columns), "a window that both ends lie in");
    let diagonal_weight = match pattern {
        StepPattern::Symmetric1 => 1.0,
        StepPattern::Symmetric2 => 2.0,
    };
    // The ways into a cell: back by this much in query and reference.
    const WAYS: [(usize, usize); 3] = [(1, 1), (0, 1), (1, 0)];
    let mut costs = vec![f64::INFINITY; rows * columns];
    let mut ways = vec![0u8; rows * columns];
    for i in 0..rows {
        for j in 0..columns {
            if outside(i, j) {
                continue;
            }
            let pair = query.state(i).iter().zip(reference.state(j));
            let local = pair.map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
            if i == 0 && j == 0 {
                costs[0] = local;
                continue;
            }
            let cell = i * columns + j;
            for (way, (back_i, back_j)) in WAYS.iter().enumerate() {
                if *back_i > i || *back_j > j {
                    continue;
                }
                let weight = if way == 0 { diagonal_weight } else { 1.0 };
                let cost = costs[(i - back_i) * columns + (j - back_j)] + weight * local;
                if cost < costs[cell] {
                    (costs[cell], ways[cell]) = (cost, way as u8);
                }
            }
        }
    }
    let (mut i, mut j) = (rows - 1, columns - 1);
    let mut path = vec![(i, j)];
    while (i, j) != (0, 0) {
        let (back_i, back_j) = WAYS[usize::from(ways[i * columns + j])];
        (i, j) = (i - back_i, j - back_j);
        path.push((i, j));
    }
    path.reverse();
    Warping { distance: costs[rows * columns - 1], path }
}

impl Warping {
    /// `motion`, which has the query's steps, with the reference's timing: each of `steps` states
    /// is the mean of those that belong to it.
    ///
    /// # Panics
    /// When `motion` or `steps` are not of the trajectories that the path is between.
    #[must_use]
    pub fn applied(&self, motion: &Trajectory, steps: usize) -> Trajectory {
        let ends = self.path.last().map(|(i, j)| (i + 1, j + 1));
        assert_eq!(ends, Some((motion.steps(), steps)), "the path is of other trajectories");
        let dim = motion.dim();
        let mut values = vec![0.0; steps * dim];
        let mut counts = vec![0.0; steps];
        for &(i, j) in &self.path {
            counts[j] += 1.0;
            values[j * dim..(j + 1) * dim]
                .iter_mut()
                .zip(motion.state(i))
                .for_each(|(v, s)| *v += s);
        }
        values.chunks_exact_mut(dim).zip(counts).for_each(|(state, count): (&mut [f64], f64)| {
            state.iter_mut().for_each(|v| *v /= count);
        });
        Trajectory::new(dim, values).expect("means of finite states")
    }
}

/// The trajectories with the timing and the length of `reference`.
///
/// # Panics
/// When their states have other numbers of values than the reference's.
pub fn align(
    trajectories: &[Trajectory],
    reference: &Trajectory,
    pattern: StepPattern,
) -> Vec<Trajectory> {
    let aligned = |t| warp(t, reference, pattern, None).applied(t, reference.steps());
    trajectories.iter().map(aligned).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn curve(steps: usize, timing: impl Fn(f64) -> f64) -> Trajectory {
        let values = (0..steps).flat_map(|i| {
            let s = timing(i as f64 / (steps - 1) as f64);
            [s, (4.0 * s).sin()]
        });
        Trajectory::new(2, values.collect()).unwrap()
    }

    fn trajectory(steps: std::ops::Range<usize>) -> impl Strategy<Value = Trajectory> {
        prop::collection::vec(prop::array::uniform2(-1.0..1.0f64), steps)
            .prop_map(|states| Trajectory::new(2, states.into_iter().flatten().collect()).unwrap())
    }

    proptest! {
        #[test]
        fn a_path_leads_from_both_starts_to_both_ends_and_costs_what_it_says(
            a in trajectory(2..12), b in trajectory(2..12),
        ) {
            for (pattern, diagonal) in [(StepPattern::Symmetric1, 1.0), (StepPattern::Symmetric2, 2.0)] {
                let Warping { distance, path } = warp(&a, &b, pattern, None);
                prop_assert_eq!(path[0], (0, 0));
                prop_assert_eq!(path[path.len() - 1], (a.steps() - 1, b.steps() - 1));
                let local = |(i, j): (usize, usize)| {
                    let (a, b) = (a.state(i), b.state(j));
                    (a[0] - b[0]).hypot(a[1] - b[1])
                };
                let mut cost = local((0, 0));
                for pair in path.windows(2) {
                    let step = (pair[1].0 - pair[0].0, pair[1].1 - pair[0].1);
                    prop_assert!([(1, 1), (0, 1), (1, 0)].contains(&step));
                    cost += local(pair[1]) * if step == (1, 1) { diagonal } else { 1.0 };
                }
                prop_assert!((cost - distance).abs() < 1e-12);
                let back = warp(&b, &a, pattern, None).distance;
                prop_assert!((back - distance).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn a_trajectory_lies_on_itself() {
        let curve = curve(20, |s| s);
        let Warping { distance, path } = warp(&curve, &curve, StepPattern::Symmetric2, None);
        assert_eq!(distance, 0.0);
        assert_eq!(path, (0..20).map(|i| (i, i)).collect::<Vec<_>>());
    }

    #[test]
    fn aligning_undoes_another_timing() {
        let (reference, late) = (curve(60, |s| s), curve(90, |s| s * s));
        let apart = |a: &Trajectory| {
            let squares = a.values().iter().zip(reference.values()).map(|(a, b)| (a - b).powi(2));
            (squares.sum::<f64>() / reference.values().len() as f64).sqrt()
        };
        let aligned = align(std::slice::from_ref(&late), &reference, StepPattern::Symmetric2);
        assert_eq!(aligned[0].steps(), 60);
        assert!(apart(&aligned[0]) < 0.02, "{}", apart(&aligned[0]));
        assert!(apart(&late.resampled(60)) > 0.2);
    }
}
