//! The devices that Burn computes on.

use serde::{Deserialize, Serialize};

/// Burn's CPU backends. Both compute the same; `flex` is several times faster.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// Burn's present CPU backend.
    #[default]
    Flex,
    /// Burn's older CPU backend on the `ndarray` crate; only in builds with the feature.
    NdArray,
}

/// A backend's name that is not known, or not in this build.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("unknown backend {name:?}; this build has: {known}")]
pub struct UnknownBackend {
    /// The name.
    pub name: String,
    /// The names that are known, comma-separated.
    pub known: String,
}

impl Backend {
    /// The backends of this build.
    pub const ALL: &[Self] = &[
        #[cfg(feature = "train")]
        Self::Flex,
        #[cfg(feature = "ndarray")]
        Self::NdArray,
    ];

    /// The name, as in configurations and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Flex => "flex",
            Self::NdArray => "ndarray",
        }
    }

    /// The device without gradients.
    ///
    /// # Panics
    /// When this build does not have the backend.
    #[cfg(feature = "train")]
    #[cfg_attr(
        feature = "ndarray",
        expect(deprecated, reason = "selectable still: docs/decisions says why")
    )]
    pub(crate) fn device(self) -> burn::tensor::Device {
        match self {
            Self::Flex => burn::tensor::Device::flex(),
            #[cfg(feature = "ndarray")]
            Self::NdArray => burn::tensor::Device::ndarray(),
            #[cfg(not(feature = "ndarray"))]
            Self::NdArray => panic!("this build has no ndarray; Backend::ALL says what it has"),
        }
    }
}

impl std::fmt::Display for Backend {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for Backend {
    type Err = UnknownBackend;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        Self::ALL.iter().copied().find(|b| b.name() == name).ok_or_else(|| UnknownBackend {
            name: name.into(),
            known: Self::ALL.iter().map(|b| b.name()).collect::<Vec<_>>().join(", "),
        })
    }
}
