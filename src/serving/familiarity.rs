//! How far a task or a manner lies from what the model was trained on.

use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;

use crate::primitive::MannerConditioned;

/// Draws from the prior that stand for it when a manner's place in it is asked for.
const PRIOR_DRAWS: usize = 2000;
/// Neighbours whose distance says how far out a task lies: the distance to the fifth nearest
/// training task, which no single odd demonstration decides.
const NEIGHBOURS: usize = 5;

/// How far out tasks and manners lie, as shares: 1 in the middle, 0 beyond everything seen.
#[derive(Debug, Clone)]
pub struct Familiarity {
    tasks: TaskFamiliarity,
    manner: MannerFamiliarity,
}

impl Familiarity {
    /// Of training tasks, each of the task space's length, and of the primitive's prior. The work
    /// grows with the square of the number of tasks: give an even selection of a thousand.
    pub fn new(training_tasks: Vec<Vec<f64>>, primitive: &dyn MannerConditioned) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let draws = (0..PRIOR_DRAWS).map(|_| primitive.sample_manner(&mut rng).values().to_vec());
        Self { manner: MannerFamiliarity::new(draws), tasks: TaskFamiliarity::new(training_tasks) }
    }

    /// The same of the tasks mirrored in the xz plane.
    pub(super) fn mirrored(&self) -> Self {
        let mirrored = |w: &Vec<f64>| w.chunks(2).flat_map(|xy| [xy[0], -xy[1]]).collect();
        let tasks = self.tasks.tasks.iter().map(mirrored).collect();
        Self { tasks: TaskFamiliarity { tasks, ..self.tasks.clone() }, manner: self.manner.clone() }
    }

    /// Share of the training tasks that lie at least as far out as `w`, by the distance to the
    /// fifth nearest training task.
    pub fn task(&self, w: &[f64]) -> f64 {
        self.tasks.share_further_out(w)
    }

    /// The training task that lies least far out: one to try a model with. None without tasks.
    pub fn most_typical_task(&self) -> Option<&[f64]> {
        self.tasks.most_typical()
    }

    /// Share of the prior that lies at least as far out as `h`.
    pub fn manner(&self, h: &[f64]) -> f64 {
        self.manner.share_further_out(h)
    }
}

/// The training tasks, and how far out each of them lies among the others.
#[derive(Debug, Clone)]
struct TaskFamiliarity {
    tasks: Vec<Vec<f64>>,
    /// Place of the task that lies least far out.
    most_typical: usize,
    /// Distance of each training task to its k-th nearest other, ascending.
    distances: Vec<f64>,
}

impl TaskFamiliarity {
    fn new(tasks: Vec<Vec<f64>>) -> Self {
        let others = |i: usize| tasks.iter().enumerate().filter(move |(j, _)| *j != i);
        let distances: Vec<_> = (0..tasks.len())
            .map(|i| kth_distance(&tasks[i], others(i).map(|(_, w)| w.as_slice())))
            .collect();
        let by_distance = |a: &usize, b: &usize| distances[*a].total_cmp(&distances[*b]);
        let most_typical = (0..tasks.len()).min_by(by_distance).unwrap_or_default();
        Self { tasks, most_typical, distances: sorted(distances) }
    }

    fn most_typical(&self) -> Option<&[f64]> {
        self.tasks.get(self.most_typical).map(Vec::as_slice)
    }

    /// Share of the training tasks that lie at least as far out as `w`: 1 amid them, 0 outside.
    fn share_further_out(&self, w: &[f64]) -> f64 {
        let distance = kth_distance(w, self.tasks.iter().map(Vec::as_slice));
        share_at_least(&self.distances, distance)
    }
}

/// How far manners drawn from the prior lie from its mean.
#[derive(Debug, Clone)]
struct MannerFamiliarity {
    /// Norms of draws, ascending.
    norms: Vec<f64>,
}

impl MannerFamiliarity {
    fn new(draws: impl Iterator<Item = Vec<f64>>) -> Self {
        Self { norms: sorted(draws.map(|h| norm(&h)).collect()) }
    }

    /// Share of the prior that lies at least as far out as `h`.
    fn share_further_out(&self, h: &[f64]) -> f64 {
        share_at_least(&self.norms, norm(h))
    }
}

fn norm(values: &[f64]) -> f64 {
    values.iter().map(|v| v * v).sum::<f64>().sqrt()
}

fn sorted(mut values: Vec<f64>) -> Vec<f64> {
    values.sort_by(f64::total_cmp);
    values
}

fn share_at_least(ascending: &[f64], value: f64) -> f64 {
    if ascending.is_empty() {
        return 0.0;
    }
    let below = ascending.partition_point(|v| *v < value);
    (ascending.len() - below) as f64 / ascending.len() as f64
}

fn kth_distance<'a>(w: &[f64], others: impl Iterator<Item = &'a [f64]>) -> f64 {
    // The k smallest so far, ascending; infinite while there are fewer.
    let mut nearest = [f64::INFINITY; NEIGHBOURS];
    for other in others {
        let distance = w.iter().zip(other).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
        let place = nearest.partition_point(|d| *d <= distance);
        if place < NEIGHBOURS {
            nearest[place..].rotate_right(1);
            nearest[place] = distance;
        }
    }
    nearest[NEIGHBOURS - 1]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid() -> Vec<Vec<f64>> {
        (0..10).flat_map(|i| (0..10).map(move |j| vec![f64::from(i), f64::from(j)])).collect()
    }

    #[test]
    fn a_task_amid_the_training_tasks_is_familiar_and_one_outside_is_not() {
        let familiarity = TaskFamiliarity::new(grid());
        assert!(familiarity.share_further_out(&[4.1, 4.0]) > 0.9);
        assert_eq!(familiarity.share_further_out(&[14.0, 4.5]), 0.0);
    }

    #[test]
    fn the_most_typical_task_is_where_they_lie_densest() {
        let mut tasks = grid();
        tasks.extend((0..6).map(|i| vec![20.0 + 0.01 * f64::from(i), 5.0]));
        let familiarity = TaskFamiliarity::new(tasks);
        assert!(familiarity.most_typical().unwrap()[0] > 19.0);
        assert_eq!(TaskFamiliarity::new(Vec::new()).most_typical(), None);
    }

    #[test]
    fn the_distance_is_that_of_the_fifth_neighbour() {
        let line: Vec<_> = (1..=9).map(|i| [f64::from(i)]).collect();
        assert_eq!(kth_distance(&[0.0], line.iter().map(<[f64; 1]>::as_slice)), 5.0);
        assert_eq!(kth_distance(&[0.0], line[..4].iter().map(<[f64; 1]>::as_slice)), f64::INFINITY);
    }

    #[test]
    fn the_mean_manner_is_the_most_familiar() {
        let familiarity = MannerFamiliarity::new((1..=4).map(|i| vec![f64::from(i), 0.0]));
        assert_eq!(familiarity.share_further_out(&[0.0, 0.0]), 1.0);
        assert_eq!(familiarity.share_further_out(&[0.0, 2.5]), 0.5);
        assert_eq!(familiarity.share_further_out(&[9.0, 0.0]), 0.0);
    }
}
