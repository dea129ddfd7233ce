//! Log messages: to the terminal in ROS's form, and to `/rosout`.
//!
//! The node's own messages go to both; those of the DDS libraries go to the terminal only, and
//! only errors of them, since rustdds warns of every multicast packet that loopback refuses.

use std::io::Write;
use std::sync::{Arc, Mutex, PoisonError, RwLock};

use log::{Level, LevelFilter, Log, Metadata, Record};
use ros2_client::builtin_interfaces::Time;
use ros2_client::{Log as LogMessage, Publisher};

use super::arguments::{Arguments, LogLevel};

/// Prefix of the targets of the node's own messages.
const OWN: &str = env!("CARGO_CRATE_NAME");

/// The logger of the process. Clones share its publisher.
#[derive(Clone)]
pub struct NodeLog(Arc<Inner>);

struct Inner {
    terminal: RwLock<env_logger::Logger>,
    to_terminal: bool,
    name: String,
    /// The levels that were set, the last of each logger counting.
    levels: Mutex<Vec<LogLevel>>,
    rosout: RwLock<Option<Publisher<LogMessage>>>,
}

impl NodeLog {
    /// Makes this the logger of the process, under the name that [`NodeNames::logger`] gives.
    ///
    /// # Errors
    /// When the process has a logger already.
    ///
    /// [`NodeNames::logger`]: super::names::NodeNames::logger
    pub fn install(name: &str, arguments: &Arguments) -> Result<Self, log::SetLoggerError> {
        let levels = arguments.log_levels.clone();
        let inner = Inner {
            terminal: RwLock::new(terminal(name, &levels)),
            to_terminal: arguments.terminal,
            name: name.into(),
            levels: Mutex::new(levels),
            rosout: RwLock::new(None),
        };
        let log = Self(Arc::new(inner));
        log.0.apply_level();
        log::set_boxed_logger(Box::new(log.clone()))?;
        Ok(log)
    }

    /// The level of a logger as a constant of `rcl_interfaces/msg/Log`; 0 where none was set.
    pub fn level(&self, name: &str) -> u32 {
        let levels = self.0.levels.lock().unwrap_or_else(PoisonError::into_inner);
        let is_own = name == self.0.name;
        let set = levels.iter().rev().find(|set| match set.logger.as_deref() {
            None => is_own,
            Some(logger) => logger == name,
        });
        match set.map(|set| set.level) {
            None if is_own => LogMessage::INFO.into(),
            None => UNSET,
            Some(LevelFilter::Off) => LogMessage::FATAL.into(),
            Some(filter) => filter.to_level().map_or(UNSET, |level| severity(level).into()),
        }
    }

    /// Sets the level of a logger to a constant of `rcl_interfaces/msg/Log`; 0 for what it is at start.
    ///
    /// # Errors
    /// A level that there is not.
    pub fn set_level(&self, name: &str, level: u32) -> Result<(), String> {
        let level = match level {
            UNSET => None,
            10 => Some(LevelFilter::Debug),
            20 => Some(LevelFilter::Info),
            30 => Some(LevelFilter::Warn),
            40 => Some(LevelFilter::Error),
            50 => Some(LevelFilter::Off),
            other => {
                return Err(format!(
                    "there is no level {other}; levels are 10 (debug), 20 (info), 30 (warn), 40 (error), \
                     50 (fatal), and 0 for that at start"
                ));
            }
        };
        let logger = (name != self.0.name).then(|| name.to_owned());
        let mut levels = self.0.levels.lock().unwrap_or_else(PoisonError::into_inner);
        levels.retain(|set| set.logger != logger && set.logger.as_deref() != Some(name));
        levels.extend(level.map(|level| LogLevel { logger, level }));
        *self.0.terminal.write().unwrap_or_else(PoisonError::into_inner) =
            terminal(&self.0.name, &levels);
        self.0.apply_level();
        Ok(())
    }

    /// Publishes the node's own messages from now on.
    pub fn attach(&self, rosout: Publisher<LogMessage>) {
        *self.0.rosout.write().unwrap_or_else(PoisonError::into_inner) = Some(rosout);
    }

    /// Publishes no more; the publisher is gone after this.
    pub fn detach(&self) {
        *self.0.rosout.write().unwrap_or_else(PoisonError::into_inner) = None;
    }
}

impl Inner {
    fn apply_level(&self) {
        let terminal = self.terminal.read().unwrap_or_else(PoisonError::into_inner);
        log::set_max_level(terminal.filter());
    }
}

/// What writes to the terminal, and says which messages count.
fn terminal(name: &str, levels: &[LogLevel]) -> env_logger::Logger {
    let mut builder = env_logger::Builder::new();
    builder.filter_level(LevelFilter::Error).filter_module(OWN, LevelFilter::Info);
    // Its one error is that leaving a multicast group fails on loopback, at every end.
    builder.filter_module("rustdds::network::udp_listener", LevelFilter::Off);
    // It warns of every ROS_DISTRO but one, while the wire format is the same since Iron.
    builder.filter_module("ros2_client::distributions", LevelFilter::Off);
    for level in levels {
        let module = match level.logger.as_deref() {
            None => OWN,
            Some(logger) if logger == name => OWN,
            Some(other) => other,
        };
        builder.filter_module(module, level.level);
    }
    let own_name = name.to_owned();
    builder.format(move |out, record| {
        let level = record.level();
        let style = out.default_level_style(level);
        let time = Time::now().to_nanos();
        let name = if is_own(record.metadata()) { &own_name } else { record.target() };
        writeln!(
            out,
            "{style}[{level}]{style:#} [{}.{:09}] [{name}]: {}",
            time / 1_000_000_000,
            time % 1_000_000_000,
            record.args()
        )
    });
    builder.build()
}

/// The constant of `rcutils` for a logger without a level of its own.
const UNSET: u32 = 0;

impl Log for NodeLog {
    fn enabled(&self, metadata: &Metadata) -> bool {
        self.0.terminal.read().unwrap_or_else(PoisonError::into_inner).enabled(metadata)
    }

    fn log(&self, record: &Record) {
        {
            let terminal = self.0.terminal.read().unwrap_or_else(PoisonError::into_inner);
            if !terminal.matches(record) {
                return;
            }
            if self.0.to_terminal {
                terminal.log(record);
            }
        }
        if !is_own(record.metadata()) {
            return;
        }
        let rosout = self.0.rosout.read().unwrap_or_else(PoisonError::into_inner);
        if let Some(rosout) = &*rosout {
            // A full window loses the message, which the terminal has; there is nobody to tell.
            let _ = rosout.publish(LogMessage {
                stamp: Time::now(),
                level: severity(record.level()),
                name: self.0.name.clone(),
                msg: record.args().to_string(),
                file: record.file().unwrap_or_default().into(),
                function: record.module_path().unwrap_or_default().into(),
                line: record.line().unwrap_or_default(),
            });
        }
    }

    fn flush(&self) {
        self.0.terminal.read().unwrap_or_else(PoisonError::into_inner).flush();
    }
}

/// Whether a message is the node's own, and not one of a library.
fn is_own(metadata: &Metadata) -> bool {
    metadata.target().starts_with(OWN)
}

/// The constants of `rcl_interfaces/msg/Log`.
fn severity(level: Level) -> u8 {
    match level {
        Level::Error => LogMessage::ERROR,
        Level::Warn => LogMessage::WARN,
        Level::Info => LogMessage::INFO,
        Level::Debug | Level::Trace => LogMessage::DEBUG,
    }
}
