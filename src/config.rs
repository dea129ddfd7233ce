//! Configuration files: TOML that people write, read into the structs of the core, and what is built
//! in for those who write none.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use saphyr::{LoadableYamlNode, Yaml};
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};

use crate::demonstrations::TaskConfig;
use crate::demonstrations::recording::{Arm, RobotConfig};
use crate::kinematics::{ArmDescription, Chain, Hull, JointLimits};
use crate::serving::{OtherArm, Robot};

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

/// The key with which a task's file names another that it changes.
const BASED_ON: &str = "based_on";
/// Files that may be based on each other in a row.
const MOST_BASES: usize = 8;

/// Reads a task such as `config/tasks/pour.toml`. One that says `based_on = "pour.toml"` is that file's,
/// relative to its own folder, but for the keys that it has itself; of a table it need not have all keys.
///
/// # Errors
/// A file that can't be read or is no task; files that are based on each other in a circle, or too deep.
pub fn task(path: &Path) -> Result<TaskConfig, ConfigError> {
    let (mut own, mut at) = (read_table(path)?, path.to_path_buf());
    let mut bases = 0;
    while let Some(base) = own.remove(BASED_ON) {
        let toml::Value::String(base) = base else {
            return Err(content(
                &at,
                &format!("{BASED_ON} is {base}; the name of a file is needed"),
            ));
        };
        if bases == MOST_BASES {
            let detail =
                format!("{bases} files are based on each other; at most {MOST_BASES} can be");
            return Err(content(path, &detail));
        }
        bases += 1;
        at = at.parent().unwrap_or(Path::new("")).join(base);
        own = merged(read_table(&at)?, own);
    }
    own.try_into().map_err(|e: toml::de::Error| content(path, &e.to_string()))
}

fn read_table(path: &Path) -> Result<toml::Table, ConfigError> {
    read(path)
}

/// A table with the keys of another in place of its own.
fn merged(mut base: toml::Table, own: toml::Table) -> toml::Table {
    for (key, value) in own {
        let value = match (base.remove(&key), value) {
            (Some(toml::Value::Table(base)), toml::Value::Table(own)) => merged(base, own).into(),
            (_, own) => own,
        };
        base.insert(key, value);
    }
    base
}

/// A robot: its configuration, its arm, and the digest of its description.
#[derive(Debug, Clone)]
pub struct LoadedRobot {
    /// The configuration.
    pub config: RobotConfig,
    /// From the base frame to the tip link, under all limits.
    pub chain: Chain,
    /// What must stay apart.
    pub hull: Hull,
    /// Links whose shape is not known.
    pub unmodelled: Vec<String>,
    /// Joints that are not the arm's, each with a position to show it in.
    pub others: Vec<(String, f64)>,
    /// Its description, as it was read.
    pub urdf: String,
    /// SHA-256 over the URDF.
    pub urdf_sha256: String,
}

impl LoadedRobot {
    /// The robot as it is served.
    pub fn served(&self) -> Robot {
        let other = |arm: &Arm| {
            let (joint_names, signs) = (arm.joints.clone(), arm.mirror_signs.clone()?);
            Some(OtherArm { joint_names, signs })
        };
        Robot {
            name: self.config.name.clone(),
            chain: self.chain.clone(),
            hull: self.hull.clone(),
            clearance_m: self.config.collision.clearance_m,
            unmodelled: self.unmodelled.clone(),
            mirrors: self.config.mirrored_arm.as_ref().and_then(other),
            others: self.others.clone(),
            description: self.urdf.as_str().into(),
        }
    }
}

/// The robot of a TOML file such as `config/robots/baxter.toml`; without a file, Baxter's left arm.
/// `parse` makes an arm of a description, a base and a tip (the `urdf` module has one).
///
/// # Errors
/// A file that can't be read or understood; a description without the base, the tip, or the arm's
/// joints between them; limits or rules that do not fit it.
pub fn robot<E: Display>(
    path: Option<&Path>,
    parse: impl Fn(&str, &str, &str) -> Result<ArmDescription, E>,
) -> Result<LoadedRobot, ConfigError> {
    let config = match path {
        Some(path) => read(path)?,
        None => RobotConfig::default(),
    };
    let here = path.unwrap_or(Path::new("the built-in robot"));
    let beside = |file: &str| here.parent().unwrap_or(Path::new("")).join(file);
    let (urdf, from) = match &config.urdf {
        None => (BAXTER_URDF.to_string(), here.to_path_buf()),
        Some(urdf) => (read_text(&beside(urdf))?, beside(urdf)),
    };
    let mut arm = parse(&urdf, &config.base_frame, &config.tip_link)
        .map_err(|e| content(&from, &e.to_string()))?;
    if arm.chain.joint_names() != config.arm.joints {
        let detail = format!(
            "between {} and {} the description moves {}; the robot's arm is configured as {}",
            config.base_frame,
            config.tip_link,
            arm.chain.joint_names().join(", "),
            config.arm.joints.join(", ")
        );
        return Err(content(&from, &detail));
    }
    if let Some(file) = &config.joint_limits {
        let file = beside(file);
        let limits = moveit_limits(&read_text(&file)?).map_err(|e| content(&file, &e))?;
        arm = arm.with_limits(&limits).map_err(|e| content(&file, &e.to_string()))?;
    }
    if let Some(unknown) =
        config.limits.keys().find(|name| config.arms().all(|arm| !arm.joints.contains(name)))
    {
        let known = config.arm.joints.join(", ");
        let detail = format!("[limits.{unknown}]: the arm has no such joint; it has {known}");
        return Err(content(here, &detail));
    }
    arm = arm.with_limits(&config.limits).map_err(|e| content(here, &e.to_string()))?;
    let hull = arm.hull(&config.collision).map_err(|e| content(here, &e.to_string()))?;
    let urdf_sha256 = hex(&Sha256::digest(urdf.as_bytes()));
    let ArmDescription { chain, unmodelled, others, .. } = arm;
    Ok(LoadedRobot { config, chain, hull, unmodelled, others, urdf, urdf_sha256 })
}

/// Limits by joint out of MoveIt's `joint_limits.yaml`: a limit counts where its `has_…_limits` is true.
fn moveit_limits(yaml: &str) -> Result<BTreeMap<String, JointLimits>, String> {
    let documents = Yaml::load_from_str(yaml).map_err(|e| e.to_string())?;
    let joints = documents.first().and_then(|document| document.as_mapping_get("joint_limits"));
    let Some(joints) = joints.and_then(Yaml::as_mapping) else {
        return Err("there is no mapping joint_limits, which MoveIt's file has".into());
    };
    let mut limits = BTreeMap::new();
    for (name, joint) in joints {
        let Some(name) = name.as_str() else {
            return Err(format!("joint_limits has a joint whose name is no text: {name:?}"));
        };
        let limit = |what: &str| match joint.as_mapping_get(&format!("has_{what}_limits")) {
            Some(has) if has.as_bool() == Some(true) => {
                let key = format!("max_{what}");
                let value = joint.as_mapping_get(&key);
                let value =
                    value.and_then(|v| v.as_floating_point().or(v.as_integer().map(|i| i as f64)));
                value.map(Some).ok_or_else(|| format!("{name} has no number {key}"))
            }
            _ => Ok(None),
        };
        let [velocity, acceleration, jerk] =
            [limit("velocity")?, limit("acceleration")?, limit("jerk")?];
        limits.insert(name.to_owned(), JointLimits { velocity, acceleration, jerk });
    }
    Ok(limits)
}

fn read_text(path: &Path) -> Result<String, ConfigError> {
    text(path).map_err(|source| ConfigError::Read { path: path.into(), source })
}

/// The text of a file that a user names.
///
/// # Errors
/// What the system says, in words that help; a file that is not UTF-8.
pub fn text(path: &Path) -> io::Result<String> {
    fs::read_to_string(path).map_err(|e| {
        let words = match e.kind() {
            io::ErrorKind::NotFound => {
                "there is no such file; see where it is, and whether the path begins there"
            }
            io::ErrorKind::IsADirectory => "this is a directory; name a file in it",
            io::ErrorKind::InvalidData => {
                "this is not text (UTF-8); see whether it is the file that you mean"
            }
            _ => return e,
        };
        io::Error::new(e.kind(), words)
    })
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
    use crate::urdf::arm;

    #[test]
    fn the_shipped_robot_file_is_the_built_in_robot() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/robots/baxter.toml");
        let (file, built_in) = (robot(Some(&path), arm).unwrap(), robot(None, arm).unwrap());
        assert_eq!(file.config, built_in.config);
        assert_eq!(file.chain, built_in.chain);
    }

    #[test]
    fn what_is_no_file_of_text_is_told_in_words() {
        let folder = tempfile::tempdir().unwrap();
        let said = |path: &Path| text(path).unwrap_err().to_string();
        assert!(said(&folder.path().join("none")).contains("no such file"));
        assert!(said(folder.path()).contains("directory"));
        let binary = folder.path().join("model");
        fs::write(&binary, [0xff, 0xfe, 0x00]).unwrap();
        assert!(said(&binary).contains("not text"));
    }

    #[test]
    fn an_unknown_key_is_refused_with_its_line() {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), "name = \"arm\"\ntip = \"hand\"\n").unwrap();
        let error = robot(Some(file.path()), arm).unwrap_err().to_string();
        assert!(error.contains("line 2") && error.contains("unknown field `tip`"), "{error}");
    }

    #[test]
    fn a_description_with_other_joints_than_the_arms_is_refused() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let text = include_str!("../config/robots/baxter.toml")
            .replace("tip_link = \"left_gripper\"", "tip_link = \"right_gripper\"");
        fs::write(file.path(), text).unwrap();
        let error = robot(Some(file.path()), arm).unwrap_err().to_string();
        assert!(error.contains("moves right_s0") && error.contains("as left_s0"), "{error}");
    }

    /// A robot's file beside MoveIt's limits and the Panda's description.
    fn limited(more: &str, yaml: &str) -> Result<LoadedRobot, ConfigError> {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
        let folder = tempfile::tempdir().unwrap();
        let text = fs::read_to_string(root.join("robots/panda.toml")).unwrap();
        let text = text.replace("../panda.urdf", &root.join("panda.urdf").display().to_string());
        let text = text.replace("[arm]", "joint_limits = \"joint_limits.yaml\"\n\n[arm]") + more;
        fs::write(folder.path().join("robot.toml"), text).unwrap();
        fs::write(folder.path().join("joint_limits.yaml"), yaml).unwrap();
        robot(Some(&folder.path().join("robot.toml")), arm)
    }

    const YAML: &str = "joint_limits:\n  panda_joint1:\n    has_velocity_limits: true\n    \
                        max_velocity: 2\n    has_acceleration_limits: true\n    max_acceleration: 3.75\n  \
                        panda_joint2:\n    has_velocity_limits: false\n    max_velocity: 0.1\n    \
                        has_jerk_limits: true\n    max_jerk: 500.0\n  panda_finger_joint1:\n    \
                        has_velocity_limits: false\n";

    #[test]
    fn limits_come_from_moveits_file_and_the_robots_own_before_them() {
        let robot = limited("\n[limits.panda_joint1]\nacceleration = 2.0\n", YAML).unwrap();
        let [first, second, ..] = robot.chain.joints() else { panic!("seven joints") };
        assert_eq!((first.velocity, first.acceleration, first.jerk), (2.0, Some(2.0), None));
        assert_eq!((second.velocity, second.acceleration, second.jerk), (2.175, None, Some(500.0)));
        assert_eq!(robot.served().chain, robot.chain);
    }

    #[test]
    fn limits_that_can_not_be_are_refused_with_the_file_and_the_joint() {
        let refused = |more: &str, yaml: &str, words: &[&str]| {
            let error = limited(more, yaml).unwrap_err().to_string();
            assert!(words.iter().all(|word| error.contains(word)), "{error}");
        };
        let own = |limit: &str| format!("\n[limits.panda_joint1]\n{limit}\n");
        refused(&own("velocity = 3.0"), YAML, &["robot.toml", "panda_joint1", "can only be lower"]);
        refused(&own("jerk = 0.0"), YAML, &["robot.toml", "panda_joint1", "above 0"]);
        refused("\n[limits.elbow]\njerk = 1.0\n", YAML, &["[limits.elbow]", "no such joint"]);
        refused("", "limits: {}", &["joint_limits.yaml", "no mapping joint_limits"]);
        refused("", &YAML.replace("3.75", "fast"), &["panda_joint1", "max_acceleration"]);
        refused("", &YAML.replace("3.75", "-1"), &["joint_limits.yaml", "above 0"]);
        refused("", "{", &["joint_limits.yaml"]);
    }

    #[test]
    fn shipped_robots_touch_nothing_by_their_build() {
        for file in ["baxter", "panda"] {
            let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/robots");
            let robot = robot(Some(&root.join(file).with_extension("toml")), arm).unwrap();
            assert!(robot.hull.parts() > 8 && robot.hull.touching().is_empty(), "{file}");
            assert!(robot.hull.table_height_m().is_some());
        }
    }

    #[test]
    fn a_robot_with_one_arm_has_no_other() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/robots/panda.toml");
        let panda = robot(Some(&path), arm).unwrap();
        assert_eq!((panda.config.arms().count(), panda.chain.dof()), (1, 7));
    }

    #[test]
    fn a_task_that_is_based_on_another_says_what_is_different() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
        let tasks = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/tasks");
        let base = tasks.join("pour.toml").display().to_string();
        write("a.toml", &format!("based_on = {base:?}\n[validity]\nmax_tilt_deg = 100.0\n"));
        write("b.toml", "based_on = \"a.toml\"\nname = \"careful\"\n");
        let mut expected = crate::demonstrations::pouring::task();
        expected.validity.max_tilt_deg = Some(100.0);
        expected.name = "careful".into();
        let found = task(&folder.path().join("b.toml")).unwrap();
        assert_eq!(found, TaskConfig::Manipulation(expected));

        write("c.toml", "based_on = \"c.toml\"\n");
        let error = task(&folder.path().join("c.toml")).unwrap_err().to_string();
        assert!(error.ends_with("8 files are based on each other; at most 8 can be"), "{error}");
        write("d.toml", "based_on = \"none.toml\"\n");
        let error = task(&folder.path().join("d.toml")).unwrap_err().to_string();
        assert!(error.contains("none.toml"), "{error}");
    }

    #[test]
    fn the_papers_pouring_differs_in_its_copies_alone() {
        let tasks = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/tasks");
        let mut expected = crate::demonstrations::pouring::task();
        expected.augmentation = crate::demonstrations::augmentation::Augmentation::paper();
        let found = task(&tasks.join("pour-paper.toml")).unwrap();
        assert_eq!(found, TaskConfig::Manipulation(expected));
    }
}
