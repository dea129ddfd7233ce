//! Task parameters `w` (what a motion must achieve) and manner parameters `h` (how it does it),
//! with the spaces that give their values a name, an order, a unit and a range.
//!
//! Values are checked once, here, at construction; nothing further in checks them again.

use serde::{Deserialize, Serialize};

/// Why values are not parameters of a space.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ParameterError {
    /// The number of values is not the number that the space has.
    #[error("{found} values where the space has {expected}: {names}")]
    Length {
        /// Values that the space has.
        expected: usize,
        /// Values that were given.
        found: usize,
        /// The names of the space's values, comma-separated.
        names: String,
    },
    /// A value is NaN or infinite.
    #[error("{name} is {value}; a finite number is needed")]
    NotFinite {
        /// Name of the value.
        name: String,
        /// The value.
        value: f64,
    },
    /// A name that the space does not have.
    #[error("unknown name {name:?}; known are: {known}")]
    Unknown {
        /// The name.
        name: String,
        /// The names of the space, comma-separated.
        known: String,
    },
    /// A manner parameter outside its bounds.
    #[error(
        "{name} = {value} is outside [{lower}, {upper}] (standard deviations of the prior); \
         choose a value inside"
    )]
    Range {
        /// Name of the value.
        name: String,
        /// The value.
        value: f64,
        /// Lower bound.
        lower: f64,
        /// Upper bound.
        upper: f64,
    },
    /// A name stands twice in a space.
    #[error("the name {name:?} stands twice")]
    Duplicate {
        /// The name.
        name: String,
    },
}

/// Interval that a value was trained on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Smallest value.
    pub lower: f64,
    /// Largest value.
    pub upper: f64,
}

impl Interval {
    /// Whether the interval holds `value`.
    pub fn contains(&self, value: f64) -> bool {
        (self.lower..=self.upper).contains(&value)
    }

    /// The interval of the values with the other sign.
    pub fn mirrored(self) -> Self {
        Self { lower: -self.upper, upper: -self.lower }
    }
}

/// One location of the task: a named point in the plane, `(x, y)` in the base frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TaskLocation {
    /// Name, which is also the name of the ROS topic (`pour_location`).
    pub name: String,
    /// Trained interval of x.
    pub x: Interval,
    /// Trained interval of y.
    pub y: Interval,
}

/// What the values of `w` mean: locations in their order, `w = (x_1, y_1, x_2, y_2, …)`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TaskSpace {
    /// Unit of every value: `m`, or `1` for unitless tasks.
    pub unit: String,
    locations: Vec<TaskLocation>,
}

impl TaskSpace {
    /// A space of these locations.
    ///
    /// # Errors
    /// A name that stands twice; an interval that is not finite.
    pub fn new(
        unit: impl Into<String>,
        locations: Vec<TaskLocation>,
    ) -> Result<Self, ParameterError> {
        for (i, location) in locations.iter().enumerate() {
            if locations[..i].iter().any(|l| l.name == location.name) {
                return Err(ParameterError::Duplicate { name: location.name.clone() });
            }
            for (axis, interval) in [("x", location.x), ("y", location.y)] {
                for value in [interval.lower, interval.upper] {
                    if !value.is_finite() {
                        let name = format!("{}.{axis}", location.name);
                        return Err(ParameterError::NotFinite { name, value });
                    }
                }
            }
        }
        Ok(Self { unit: unit.into(), locations })
    }

    /// The locations, in the order of their values in `w`.
    pub fn locations(&self) -> &[TaskLocation] {
        &self.locations
    }

    /// Number of values in `w`: two for each location.
    pub fn dim(&self) -> usize {
        2 * self.locations.len()
    }

    /// Place of a location among the space's locations.
    pub fn location_index(&self, name: &str) -> Option<usize> {
        self.locations.iter().position(|l| l.name == name)
    }

    /// Names of the values: `pour_location.x`, `pour_location.y`, …
    pub fn value_names(&self) -> Vec<String> {
        let names = |l: &TaskLocation| [format!("{}.x", l.name), format!("{}.y", l.name)];
        self.locations.iter().flat_map(names).collect()
    }

    /// Trained intervals of the values, in the order of `w`.
    pub fn intervals(&self) -> Vec<Interval> {
        self.locations.iter().flat_map(|l| [l.x, l.y]).collect()
    }

    /// The space mirrored in the xz plane.
    pub fn mirrored(&self) -> Self {
        let mirrored = |l: &TaskLocation| TaskLocation { y: l.y.mirrored(), ..l.clone() };
        Self { unit: self.unit.clone(), locations: self.locations.iter().map(mirrored).collect() }
    }

    /// Distance between two task parameters: the largest over the locations, in the space's unit.
    pub fn distance(&self, a: &TaskParameters, b: &TaskParameters) -> f64 {
        let pairs = a.values().chunks(2).zip(b.values().chunks(2));
        pairs.map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1])).fold(0.0, f64::max)
    }
}

/// Task parameters `w`: finite values of a [`TaskSpace`], in its order and unit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TaskParameters(Vec<f64>);

impl TaskParameters {
    /// Parameters of `space`.
    ///
    /// # Errors
    /// A wrong number of values, or a value that is not finite. Whether they lie where the model
    /// was trained is the server's question, not one of being parameters.
    pub fn new(space: &TaskSpace, values: Vec<f64>) -> Result<Self, ParameterError> {
        check(&space.value_names(), &values)?;
        Ok(Self(values))
    }

    /// The values, in the order of the space.
    pub fn values(&self) -> &[f64] {
        &self.0
    }

    /// `(x, y)` of the location at `index` of the space.
    pub fn location(&self, index: usize) -> [f64; 2] {
        [self.0[2 * index], self.0[2 * index + 1]]
    }

    /// The task mirrored in the xz plane.
    pub fn mirrored(&self) -> Self {
        Self(self.0.chunks(2).flat_map(|xy| [xy[0], -xy[1]]).collect())
    }
}

/// One manner parameter: its name, its bounds, and what training found that it does.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MannerAxis {
    /// Name, such as `pour_duration`; `h3` where no factor dominates.
    pub name: String,
    /// Smallest value, in standard deviations of the prior.
    pub lower: f64,
    /// Largest value, in standard deviations of the prior.
    pub upper: f64,
    /// What one unit changes: `+0.6 s above 70 degrees per unit (R2 0.91)`, or `no effect`.
    pub effect: String,
}

/// What the values of `h` mean.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MannerSpace {
    axes: Vec<MannerAxis>,
}

impl MannerSpace {
    /// A space of these axes.
    ///
    /// # Errors
    /// A name that stands twice.
    pub fn new(axes: Vec<MannerAxis>) -> Result<Self, ParameterError> {
        for (i, axis) in axes.iter().enumerate() {
            if axes[..i].iter().any(|a| a.name == axis.name) {
                return Err(ParameterError::Duplicate { name: axis.name.clone() });
            }
        }
        Ok(Self { axes })
    }

    /// Axes `h1 … hn` of which nothing is known yet, bounded at `bound` standard deviations.
    pub fn unnamed(dim: usize, bound: f64) -> Self {
        let axis = |i| MannerAxis {
            name: format!("h{}", i + 1),
            lower: -bound,
            upper: bound,
            effect: "not measured".into(),
        };
        Self { axes: (0..dim).map(axis).collect() }
    }

    /// The space of a primitive without manner parameters.
    pub const fn none() -> Self {
        Self { axes: Vec::new() }
    }

    /// The axes, in the order of their values in `h`.
    pub fn axes(&self) -> &[MannerAxis] {
        &self.axes
    }

    /// Number of values in `h`.
    pub fn dim(&self) -> usize {
        self.axes.len()
    }

    /// Place of an axis among the space's axes.
    ///
    /// # Errors
    /// [`ParameterError::Unknown`] with the names that are known.
    pub fn index(&self, name: &str) -> Result<usize, ParameterError> {
        self.axes.iter().position(|a| a.name == name).ok_or_else(|| ParameterError::Unknown {
            name: name.into(),
            known: match self.axes.as_slice() {
                [] => "none, as the primitive has no manner parameters".into(),
                _ => self.names().join(", "),
            },
        })
    }

    /// Names of the axes.
    pub fn names(&self) -> Vec<String> {
        self.axes.iter().map(|a| a.name.clone()).collect()
    }
}

/// Manner parameters `h`: finite values inside the bounds of a [`MannerSpace`], in standard
/// deviations of the prior.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MannerParameters(Vec<f64>);

impl MannerParameters {
    /// Parameters of `space`.
    ///
    /// # Errors
    /// A wrong number of values, a value that is not finite, a value outside its bounds.
    pub fn new(space: &MannerSpace, values: Vec<f64>) -> Result<Self, ParameterError> {
        check(&space.names(), &values)?;
        for (axis, &value) in space.axes.iter().zip(&values) {
            if !(axis.lower..=axis.upper).contains(&value) {
                return Err(ParameterError::Range {
                    name: axis.name.clone(),
                    value,
                    lower: axis.lower,
                    upper: axis.upper,
                });
            }
        }
        Ok(Self(values))
    }

    /// The values, each at its nearest bound where it lies outside.
    ///
    /// # Panics
    /// When there is not one finite value for each axis.
    pub fn clamped(space: &MannerSpace, values: &[f64]) -> Self {
        assert_eq!(values.len(), space.dim(), "one value for each axis");
        let inside = space.axes.iter().zip(values).map(|(a, v)| v.clamp(a.lower, a.upper));
        Self::new(space, inside.collect()).expect("finite values")
    }

    /// The prior's mean: every value 0.
    pub fn mean(space: &MannerSpace) -> Self {
        Self(vec![0.0; space.dim()])
    }

    /// The values, in the order of the space.
    pub fn values(&self) -> &[f64] {
        &self.0
    }
}

/// The checks that both kinds of parameters share: as many values as names, each finite.
fn check(names: &[String], values: &[f64]) -> Result<(), ParameterError> {
    if names.len() != values.len() {
        return Err(ParameterError::Length {
            expected: names.len(),
            found: values.len(),
            names: names.join(", "),
        });
    }
    match names.iter().zip(values).find(|(_, v)| !v.is_finite()) {
        Some((name, &value)) => Err(ParameterError::NotFinite { name: name.clone(), value }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn space() -> TaskSpace {
        let interval = Interval { lower: 0.4, upper: 0.9 };
        let location = |name: &str| TaskLocation { name: name.into(), x: interval, y: interval };
        TaskSpace::new("m", vec![location("pour_location"), location("source_cup")]).unwrap()
    }

    #[test]
    fn a_wrong_number_of_values_is_refused_with_both_numbers() {
        let error = TaskParameters::new(&space(), vec![0.5; 3]).unwrap_err();
        assert_eq!(
            error.to_string(),
            "3 values where the space has 4: \
             pour_location.x, pour_location.y, source_cup.x, source_cup.y"
        );
    }

    #[test]
    fn a_value_that_is_not_finite_is_refused_by_name() {
        let error = TaskParameters::new(&space(), vec![0.5, 0.5, f64::NAN, 0.5]).unwrap_err();
        assert_eq!(error.to_string(), "source_cup.x is NaN; a finite number is needed");
    }

    #[test]
    fn the_distance_is_that_of_the_worst_location() {
        let space = space();
        let a = TaskParameters::new(&space, vec![0.5, 0.5, 0.6, 0.6]).unwrap();
        let b = TaskParameters::new(&space, vec![0.53, 0.54, 0.6, 0.61]).unwrap();
        assert!((space.distance(&a, &b) - 0.05).abs() < 1e-12);
    }

    #[test]
    fn a_manner_parameter_outside_its_bounds_is_refused() {
        let error =
            MannerParameters::new(&MannerSpace::unnamed(2, 3.0), vec![0.0, 3.5]).unwrap_err();
        assert!(matches!(error, ParameterError::Range { ref name, .. } if name == "h2"));
    }

    #[test]
    fn a_name_may_not_stand_twice() {
        let location = space().locations()[0].clone();
        assert!(TaskSpace::new("m", vec![location.clone(), location]).is_err());
    }
}
