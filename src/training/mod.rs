//! Training: the alternating optimisation of eq. 14.

mod adam;

pub use adam::Adam;
