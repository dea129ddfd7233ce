//! Learned movement primitives for ROS 2.
//!
//! The Task-Conditioned Variational Autoencoder (TC-VAE; Noseworthy, Paul, Roy, Park and Roy,
//! *Task-Conditioned Variational Autoencoders for Learning Movement Primitives*, CoRL 2019)
//! separates what a motion must achieve, the task parameters `w`, from how it is done, the
//! manner parameters `h`. This crate trains such models from demonstrations, and serves them
//! as checked end-effector and joint trajectories.
//!
//! # Example
//! A pour by the shipped model, and where it pours in truth:
//!
//! ```
//! use std::path::Path;
//!
//! use rand::{SeedableRng, rngs::ChaCha8Rng};
//! use tcvae::artifact::Artifact;
//! use tcvae::trajectory::Motion;
//! use tcvae::{MannerConditioned, MovementPrimitive, TaskParameters};
//!
//! let artifact = Artifact::load(Path::new("models/pouring.safetensors"))?;
//! let primitive = artifact.primitive();
//! // Where to pour, and where the cup stands: x and y of each, in metres in the robot's base frame.
//! let w = TaskParameters::new(primitive.task_space(), vec![0.65, 0.35, 0.60, 0.10])?;
//! let h = primitive.sample_manner(&mut ChaCha8Rng::seed_from_u64(1));
//!
//! let states = primitive.decode(&w, &h).mean;
//! let motion = Motion { states, duration_secs: artifact.document.duration_secs };
//! let reached = artifact.document.task.task().empirical_task(&motion)?;
//! assert!(primitive.task_space().distance(&w, &reached) < 0.02);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Modules
//! Each module may use those above it and none below.
//!
//! | module | what it holds |
//! |---|---|
//! | [`parameters`] | task and manner parameters and the spaces that they live in |
//! | [`trajectory`] | trajectories over phase and over time |
//! | [`alignment`] | motions on a common clock, by the events of their task |
//! | [`pose`] | end-effector poses, and how they become 6-D states |
//! | [`primitive`] | the traits of a movement primitive |
//! | [`kinematics`] | chains, forward kinematics, inverse kinematics of whole paths, timing |
//! | [`primitives`] | baselines: task-parameterised Gaussian mixtures, ProMPs, DMPs, time warping |
//! | [`model`] | the TC-VAE: its networks, its objective, and its packed decoder |
//! | [`demonstrations`] | tasks, what they measure, and the demonstrations of them |
//! | [`evaluation`] | SUCCESS, ROBUSTNESS, leak, validity |
//! | [`training`] | the alternating optimisation (feature `train`) |
//! | [`serving`] | the state and the rules of the node, without any I/O |
//!
//! The adapters, [`config`], [`artifact`], [`dataset`], [`urdf`], [`mime`], `bag`,
//! `csv`, `archive`, `ros` and [`report`], don't know each other; the two binaries wire them together.

pub mod parameters;

pub mod trajectory;

pub mod alignment;

pub mod pose;

pub mod primitive;

pub mod kinematics;

pub mod primitives;

pub mod model;

pub mod demonstrations;

pub mod evaluation;

pub mod training;

pub mod serving;

// Adapters: they don't know each other; the binaries wire them.
#[cfg(feature = "bag")]
pub mod archive;
pub mod artifact;
#[cfg(feature = "bag")]
pub mod bag;
pub mod config;
#[cfg(feature = "bag")]
pub mod csv;
pub mod dataset;
pub mod mime;
pub mod report;
#[cfg(feature = "ros")]
pub mod ros;
pub mod urdf;

pub use parameters::{MannerParameters, TaskParameters, TaskSpace};
pub use primitive::{MannerConditioned, MovementPrimitive};
pub use trajectory::{EndEffectorTrajectory, JointTrajectory, Trajectory};
