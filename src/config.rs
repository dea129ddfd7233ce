//! Configuration files: TOML that people write, read into the structs of the core, and what is built
//! in for those who write none.

use std::fmt::Display;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};

use crate::demonstrations::recording::RobotConfig;
use crate::kinematics::Chain;

/// The Baxter description that is built in.
pub const BAXTER_URDF: &str = include_str!("../config/baxter.urdf");

/// Why a configuration can't be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file can't be read.
    #[error("{}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The file does not say what it should.
    #[error("{}: {detail}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// Line, key and what is wrong with it.
        detail: String,
    },
}

/// Reads a TOML file; unknown keys are refused.
///
/// # Errors
/// A file that can't be read, or that is not such a configuration.
pub fn read<T: DeserializeOwned>(path: &Path) -> Result<T, ConfigError> {
    toml::from_str(&read_text(path)?).map_err(|e| content(path, &e.to_string()))
}

/// A robot: its configuration, its arm, and the digest of its description.
#[derive(Debug, Clone)]
pub struct LoadedRobot {
    /// The configuration.
    pub config: RobotConfig,
    /// From the base frame to the tip link.
    pub chain: Chain,
    /// SHA-256 over the URDF.
    pub urdf_sha256: String,
}

/// The robot of a TOML file such as `config/robots/baxter.toml`; without a file, Baxter's left arm.
/// `parse` makes a chain of a description, a base and a tip (the `urdf` module has one).
///
/// # Errors
/// A file that can't be read or understood; a description without the base, the tip, or the arm's
/// joints between them.
pub fn robot<E: Display>(
    path: Option<&Path>,
    parse: impl Fn(&str, &str, &str) -> Result<Chain, E>,
) -> Result<LoadedRobot, ConfigError> {
    let config = match path {
        Some(path) => read(path)?,
        None => RobotConfig::default(),
    };
    let here = path.unwrap_or(Path::new("the built-in robot"));
    let (urdf, from) = match &config.urdf {
        None => (BAXTER_URDF.to_string(), here.to_path_buf()),
        Some(urdf) => {
            let urdf = here.parent().unwrap_or(Path::new("")).join(urdf);
            (read_text(&urdf)?, urdf)
        }
    };
    let chain = parse(&urdf, &config.base_frame, &config.tip_link)
        .map_err(|e| content(&from, &e.to_string()))?;
    if chain.joint_names() != config.arm.joints {
        let detail = format!(
            "between {} and {} the description moves {}; the robot's arm is configured as {}",
            config.base_frame,
            config.tip_link,
            chain.joint_names().join(", "),
            config.arm.joints.join(", ")
        );
        return Err(content(&from, &detail));
    }
    Ok(LoadedRobot { urdf_sha256: hex(&Sha256::digest(urdf.as_bytes())), config, chain })
}

fn read_text(path: &Path) -> Result<String, ConfigError> {
    fs::read_to_string(path).map_err(|source| ConfigError::Read { path: path.into(), source })
}

fn content(path: &Path, detail: &str) -> ConfigError {
    ConfigError::Content { path: path.into(), detail: detail.trim_end().into() }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::urdf::chain;

    #[test]
    fn the_shipped_robot_file_is_the_built_in_robot() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/robots/baxter.toml");
        let (file, built_in) = (robot(Some(&path), chain).unwrap(), robot(None, chain).unwrap());
        assert_eq!(file.config, built_in.config);
        assert_eq!(file.chain, built_in.chain);
    }

    #[test]
    fn an_unknown_key_is_refused_with_its_line() {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), "name = \"arm\"\ntip = \"hand\"\n").unwrap();
        let error = robot(Some(file.path()), chain).unwrap_err().to_string();
        assert!(error.contains("line 2") && error.contains("unknown field `tip`"), "{error}");
    }

    #[test]
    fn a_description_with_other_joints_than_the_arms_is_refused() {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), "tip_link = \"right_gripper\"\n").unwrap();
        let error = robot(Some(file.path()), chain).unwrap_err().to_string();
        assert!(error.contains("moves right_s0") && error.contains("as left_s0"), "{error}");
    }
}
