//! `tcvae record`: what is said on the ROS graph becomes a recording.

use std::collections::BTreeSet;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;

use tcvae::bag::definitions;
use tcvae::bag::writer::{BagWriter, Compression, OfferedQos, RawMessage, TopicId};
use tcvae::demonstrations::TaskConfig;
use tcvae::demonstrations::recording::RobotConfig;
use tcvae::ros::arguments::{Arguments, Command};
use tcvae::ros::environment::Environment;
use tcvae::ros::names::NodeNames;
use tcvae::ros::recorder::{self, Heard, Offer, Recorder, Topic, Wanted};

use super::sources::{load_robot, load_task};
use super::train::stop_on_signal;
use super::{ExitStatus, UsageError, print_json, print_line};

/// What the recorder is called on the graph.
const NODE: &str = "tcvae_record";
const JOINT_STATES: &str = "/joint_states";
const JOINT_STATE: &str = "sensor_msgs/msg/JointState";

/// A topic that is silent this long is warned of, and joints that are missing.
const PATIENCE: Duration = Duration::from_secs(5);
/// How often the file is brought up to date, and a person.
const EVERY: Duration = Duration::from_secs(1);
/// How often where no person watches.
const EVERY_UNWATCHED: Duration = Duration::from_secs(10);

/// How chunks are compressed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
enum CompressionArg {
    /// With Zstandard
    #[default]
    Zstd,
    /// Not at all
    None,
}

/// What to listen to, and for how long.
#[derive(Debug, Clone, Default, PartialEq, Args)]
pub(crate) struct Listening {
    /// Topic of joint states, /joint_states without it; several where several say them
    #[arg(long, value_name = "TOPIC")]
    joint_states: Vec<String>,
    /// Another topic to record, such as a marker's; its type is found, or given
    #[arg(long, value_name = "NAME[:TYPE]")]
    topic: Vec<String>,
    /// End after this time; without it, Ctrl-C ends
    #[arg(long, value_name = "SECS", value_parser = seconds)]
    duration: Option<Duration>,
    /// End after so many messages
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    messages: Option<u64>,
    /// Compression of the recording
    #[arg(long, value_enum, default_value_t)]
    compression: CompressionArg,
    /// Replace a recording that is there already
    #[arg(long)]
    force: bool,
    /// Remaps and the namespace, as a node takes them: --ros-args -r joint_states:=/arm/joint_states
    #[arg(long, value_name = "ARGS", num_args = 0.., allow_hyphen_values = true, value_terminator = "--")]
    ros_args: Vec<String>,
}

impl Listening {
    /// Also to what a task needs to hear of.
    fn for_task(&self, task: Option<&Path>) -> anyhow::Result<Self> {
        let mut listening = self.clone();
        if let TaskConfig::Manipulation(task) = load_task(task)? {
            listening.topic.extend(task.topics().map(String::from));
        }
        Ok(listening)
    }
}

/// Recording before training.
#[derive(Debug, Default, Args)]
#[command(next_help_heading = "Recording live")]
pub(crate) struct Live {
    /// Record from the ROS graph first, and train on that too; Ctrl-C ends the recording
    #[arg(long, conflicts_with = "resume")]
    live: bool,
    /// File to keep the recording in; without it, beside the model
    #[arg(long, value_name = "F.mcap", requires = "live")]
    record: Option<PathBuf>,
    #[command(flatten)]
    listening: Listening,
}

impl Live {
    /// Records where that is asked for: the file, and the flag that signals set from now on.
    pub(crate) fn record(
        &self,
        model: &Path,
        robot: Option<&Path>,
        task: Option<&Path>,
    ) -> anyhow::Result<Option<(PathBuf, Arc<AtomicBool>)>> {
        let Self { live, record: file, listening } = self;
        if !live {
            if *listening != Listening::default() {
                let flags = "--joint-states, --topic, --duration and the like are for --live; \
                             recordings that are given are read whole";
                return Err(UsageError(flags.into()).into());
            }
            return Ok(None);
        }
        let file = file.clone().unwrap_or_else(|| model.with_extension("mcap"));
        let robot = load_robot(robot)?;
        let listening = listening.for_task(task)?;
        let stop = stop_on_signal()?;
        let recorded = record(&file, &listening, Some(&robot.config), &stop)?;
        recorded.lines().iter().for_each(|line| eprintln!("{line}"));
        // The next signal is for the training.
        stop.store(false, Ordering::Relaxed);
        Ok(Some((file, stop)))
    }
}

/// Arguments of `tcvae record`.
#[derive(Debug, Args)]
pub(crate) struct RecordArgs {
    /// MCAP file to write
    #[arg(short, long, value_name = "F.mcap")]
    output: PathBuf,
    /// The robot: its grippers' topics are recorded too, and joints that are missing are warned of
    #[arg(long, value_name = "F.toml")]
    robot: Option<PathBuf>,
    /// The task: the topics that tell its locations, or mark demonstrations, are recorded too
    #[arg(long, value_name = "F.toml")]
    task: Option<PathBuf>,
    #[command(flatten)]
    listening: Listening,
    /// Print the answer as JSON
    #[arg(long)]
    pub(crate) json: bool,
}

pub(crate) fn run(args: RecordArgs) -> anyhow::Result<ExitStatus> {
    let RecordArgs { output, robot, task, listening, json } = args;
    let listening = listening.for_task(task.as_deref())?;
    let robot = robot.map(|path| load_robot(Some(&path))).transpose()?;
    let stop = stop_on_signal()?;
    let recorded = record(&output, &listening, robot.map(|robot| robot.config).as_ref(), &stop)?;
    if json {
        print_json(&recorded.answer());
    } else {
        recorded.lines().iter().for_each(|line| print_line(line));
    }
    Ok(ExitStatus::Done)
}

fn seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse().ok().and_then(|secs| Duration::try_from_secs_f64(secs).ok());
    let some = seconds.filter(|duration| !duration.is_zero());
    some.ok_or_else(|| "a number of seconds above 0 is needed".into())
}

/// A recording that was made.
#[derive(Debug)]
pub(crate) struct Recorded {
    file: PathBuf,
    /// From the first message to the last.
    seconds: f64,
    topics: Vec<Topic>,
    joints: BTreeSet<String>,
    missing_joints: Vec<String>,
    /// Types that the recording has no definition of.
    undefined: BTreeSet<String>,
}

impl Recorded {
    fn answer(&self) -> serde_json::Value {
        let Self { file, seconds, topics, joints, missing_joints, undefined } = self;
        let of_topic = |topic: &Topic| {
            let defined = topic.type_name.as_ref().is_some_and(|name| !undefined.contains(name));
            json!({
                "name": topic.name, "type": topic.type_name, "messages": topic.messages,
                "dropped": topic.lost(), "has_definition": defined,
            })
        };
        json!({
            "file": file, "seconds": seconds, "messages": self.messages(),
            "dropped": topics.iter().map(Topic::lost).sum::<u64>(),
            "topics": topics.iter().map(of_topic).collect::<Vec<_>>(),
            "joints": joints, "missing_joints": missing_joints,
        })
    }

    /// The same for a person.
    fn lines(&self) -> Vec<String> {
        let Self { file, seconds, topics, .. } = self;
        let (file, messages) = (file.display(), self.messages());
        let mut lines = vec![format!("{file}: {messages} messages in {seconds:.1} s")];
        lines.extend(topics.iter().map(|topic| {
            let type_name = topic.type_name.as_deref().unwrap_or("unknown");
            let lost = match topic.lost() {
                0 => String::new(),
                lost => format!(", {lost} lost"),
            };
            format!("  {} ({type_name}): {}{lost}", topic.name, topic.messages)
        }));
        lines
    }

    fn messages(&self) -> u64 {
        self.topics.iter().map(|topic| topic.messages).sum()
    }
}

/// Records into `output` until `stop` is set, or the listening has an end itself.
///
/// # Errors
/// Wrong usage; nothing was heard, and then there is no file; what was recorded can't be written.
pub(crate) fn record(
    output: &Path,
    listening: &Listening,
    robot: Option<&RobotConfig>,
    stop: &AtomicBool,
) -> anyhow::Result<Recorded> {
    let usage = |e: &dyn std::fmt::Display| UsageError(e.to_string());
    let ros_args = ["--ros-args".to_owned()].into_iter().chain(listening.ros_args.iter().cloned());
    let remaps = match Arguments::parse(ros_args).map_err(|e| usage(&e))? {
        Command::Run(arguments) => arguments.remaps,
        _ => Vec::new(),
    };
    let names = NodeNames::new(NODE, &remaps).map_err(|e| usage(&e))?;
    let environment = Environment::read(|name| std::env::var(name).ok()).map_err(|e| usage(&e))?;
    let topics = wanted(listening, robot, &names)?;
    let Listening { compression, force, .. } = *listening;
    let compression = match compression {
        CompressionArg::Zstd => Compression::Zstd,
        CompressionArg::None => Compression::None,
    };
    let bag = BagWriter::create(output, compression, force).map_err(|e| usage(&e))?;
    for warning in &environment.warnings {
        eprintln!("{warning}");
    }
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_time().build()?;
    let done = runtime.block_on(async {
        let recorder = match Recorder::start(&environment, &names, topics) {
            Ok(recorder) => recorder,
            Err(e) => {
                bag.discard();
                return Err(usage(&e).into());
            }
        };
        let session = Session {
            bag,
            ids: vec![None; recorder.topics().len()],
            arms: robot.map(arms).unwrap_or_default(),
            joints: BTreeSet::new(),
            undefined: BTreeSet::new(),
            ends: None,
            status: Status::new(),
        };
        session.run(recorder, output, listening, &environment, stop).await
    });
    runtime.shutdown_background();
    done
}

/// The topics to listen to, each once.
fn wanted(
    listening: &Listening,
    robot: Option<&RobotConfig>,
    names: &NodeNames,
) -> Result<Vec<Wanted>, UsageError> {
    let mut wanted: Vec<Wanted> = Vec::new();
    let mut add = |name: &str, type_name: Option<&str>| {
        let name = names.topic(name).map_err(|e| UsageError(e.to_string()))?;
        let type_name = type_name.map(str::to_owned);
        match wanted.iter_mut().find(|wanted| wanted.name == name) {
            Some(known) => known.type_name = known.type_name.take().or(type_name),
            None => wanted.push(Wanted { name, type_name }),
        }
        Ok(())
    };
    match &listening.joint_states[..] {
        [] => add(JOINT_STATES, Some(JOINT_STATE))?,
        topics => topics.iter().try_for_each(|topic| add(topic, Some(JOINT_STATE)))?,
    }
    for arm in robot.into_iter().flat_map(RobotConfig::arms) {
        if let Some(topic) = &arm.gripper_source.topic {
            add(topic, None)?;
        }
    }
    for topic in &listening.topic {
        match topic.split_once(':') {
            None => add(topic, None)?,
            Some((name, type_name)) => {
                let parts: Vec<_> = type_name.split('/').collect();
                let ([package, "msg", message] | [package, message]) = parts[..] else {
                    return Err(UsageError(format!(
                        "--topic {topic}: {type_name:?} is no type; write it as std_msgs/msg/Bool"
                    )));
                };
                add(name, Some(&format!("{package}/msg/{message}")))?;
            }
        }
    }
    Ok(wanted)
}

/// The names of the joints of each arm.
fn arms(robot: &RobotConfig) -> Vec<Vec<String>> {
    robot.arms().map(|arm| arm.joints.clone()).collect()
}

/// Writing what is heard.
struct Session {
    bag: BagWriter,
    /// Topics in the bag; none before their first message.
    ids: Vec<Option<TopicId>>,
    arms: Vec<Vec<String>>,
    joints: BTreeSet<String>,
    undefined: BTreeSet<String>,
    /// Times of the first message and of the last.
    ends: Option<[u64; 2]>,
    status: Status,
}

impl Session {
    async fn run(
        mut self,
        mut recorder: Recorder,
        output: &Path,
        listening: &Listening,
        environment: &Environment,
        stop: &AtomicBool,
    ) -> anyhow::Result<Recorded> {
        let names: Vec<_> = recorder.topics().iter().map(|topic| topic.name.as_str()).collect();
        let how = match (listening.duration, listening.messages) {
            (None, None) => "; Ctrl-C ends the recording",
            _ => "",
        };
        let domain = environment.domain;
        self.status.say(&format!("listening to {} in domain {domain}{how}", names.join(", ")));
        let most = listening.messages.unwrap_or(u64::MAX);
        let began = Instant::now();
        let mut tick = tokio::time::interval(Duration::from_millis(50));
        let mut messages = 0;
        let mut watch = Watch::default();
        while messages < most {
            tokio::select! {
                heard = recorder.next() => {
                    let heard = heard.with_context(|| {
                        let partial = self.bag.partial().display();
                        format!("what was recorded until then is in {partial}")
                    })?;
                    self.write(&heard, recorder.topics())?;
                    messages += 1;
                }
                _ = tick.tick() => {
                    let passed = began.elapsed();
                    if stop.load(Ordering::Relaxed)
                        || listening.duration.is_some_and(|duration| passed >= duration)
                    {
                        break;
                    }
                    self.announce(&recorder, &mut watch);
                    if passed >= watch.next {
                        watch.next = passed + EVERY;
                        self.bag.flush()?;
                        self.tell(&recorder, passed, &mut watch);
                    }
                }
            }
        }
        for heard in recorder.stop(most - messages).await {
            self.write(&heard, recorder.topics())?;
        }
        self.status.end();
        self.finish(&recorder, output, environment, began.elapsed())
    }

    fn write(&mut self, heard: &Heard, topics: &[Topic]) -> anyhow::Result<()> {
        let topic = &topics[heard.topic];
        let type_name = topic.type_name.as_deref().unwrap_or_default();
        let id = match self.ids[heard.topic] {
            Some(id) => id,
            None => {
                let definition = definitions::definition(type_name, installed);
                if definition.is_none() && self.undefined.insert(type_name.into()) {
                    self.status.say(&format!(
                        "{}: no definition of {type_name} is known, so that other tools show its \
                         messages as bytes; it is found where its package is installed and sourced",
                        topic.name
                    ));
                }
                let offered: BTreeSet<_> = topic.offers.iter().map(offered).collect();
                let offered: Vec<_> = offered.into_iter().collect();
                let id = self.bag.topic(&topic.name, type_name, definition.as_deref(), &offered)?;
                *self.ids[heard.topic].insert(id)
            }
        };
        if type_name == JOINT_STATE
            && let Some(names) = recorder::joint_names(&heard.data)
        {
            for name in names {
                if !self.joints.contains(&name) {
                    self.joints.insert(name);
                }
            }
        }
        let Heard { received_nanos, sent_nanos, number, .. } = *heard;
        self.bag.write(
            id,
            RawMessage {
                log_nanos: received_nanos,
                publish_nanos: sent_nanos.unwrap_or(received_nanos),
                sequence: number as u32,
                data: &heard.data,
            },
        )?;
        let [first, last] = self.ends.get_or_insert([received_nanos; 2]);
        *first = received_nanos.min(*first);
        *last = received_nanos.max(*last);
        Ok(())
    }

    /// Joints that are missing of the arm that lacks least; none where an arm is complete.
    fn missing_joints(&self) -> Vec<String> {
        let missing = |arm: &Vec<String>| -> Vec<String> {
            arm.iter().filter(|joint| !self.joints.contains(*joint)).cloned().collect()
        };
        self.arms.iter().map(missing).min_by_key(Vec::len).unwrap_or_default()
    }

    /// Says which topics have publishers by now.
    fn announce(&self, recorder: &Recorder, watch: &mut Watch) {
        for topic in recorder.topics().iter().filter(|topic| !topic.offers.is_empty()) {
            if watch.found.insert(topic.name.clone()) {
                let type_name = topic.type_name.as_deref().unwrap_or_default();
                let publishers = plural(topic.offers.len(), "publisher");
                self.status.say(&format!("{}: {type_name} of {publishers}", topic.name));
            }
        }
    }

    /// Says what is going on, and once what should not.
    fn tell(&mut self, recorder: &Recorder, passed: Duration, watch: &mut Watch) {
        let topics = recorder.topics();
        if passed >= PATIENCE && !watch.warned {
            watch.warned = true;
            for topic in topics.iter().filter(|topic| topic.messages == 0) {
                self.status.say(&silent(topic));
            }
            let missing = self.missing_joints();
            if !missing.is_empty() && !self.joints.is_empty() {
                self.status.say(&format!(
                    "warning: the robot's {} came in no joint states so far, which name {}; is \
                     --robot the right one, or does another topic say them (--joint-states)?",
                    missing.join(", "),
                    self.joints.iter().map(String::as_str).collect::<Vec<_>>().join(", ")
                ));
            }
        }
        let counts = topics.iter().map(|topic| format!("{} {}", topic.name, topic.messages));
        let counts = counts.collect::<Vec<_>>().join(", ");
        let lost: u64 = topics.iter().map(Topic::lost).sum();
        let lost = if lost > 0 { format!("; {lost} lost") } else { String::new() };
        self.status.show(passed, &format!("{:.0} s: {counts}{lost}", passed.as_secs_f64()));
    }

    fn finish(
        self,
        recorder: &Recorder,
        output: &Path,
        environment: &Environment,
        passed: Duration,
    ) -> anyhow::Result<Recorded> {
        let missing_joints = self.missing_joints();
        let Self { bag, joints, undefined, ends, .. } = self;
        let Some([first, last]) = ends else {
            bag.discard();
            bail!(nothing(recorder, environment, passed));
        };
        bag.finish()?;
        Ok(Recorded {
            file: output.into(),
            seconds: (last - first) as f64 * 1e-9,
            topics: recorder.topics().to_vec(),
            joints,
            missing_joints,
            undefined,
        })
    }
}

/// What was said already.
#[derive(Debug, Default)]
struct Watch {
    next: Duration,
    found: BTreeSet<String>,
    warned: bool,
}

fn plural(count: usize, what: &str) -> String {
    if count == 1 { format!("1 {what}") } else { format!("{count} {what}s") }
}

/// Why a topic says nothing.
fn silent(topic: &Topic) -> String {
    let Topic { name, offers, other_types, type_name, .. } = topic;
    let others = other_types.iter().map(String::as_str).collect::<Vec<_>>().join(", ");
    match (offers.len(), type_name) {
        (0, Some(type_name)) if !others.is_empty() => format!(
            "warning: {name} is published as {others}, and listened to as {type_name}; name the type \
             with --topic {name}:TYPE, or another topic"
        ),
        (0, _) => format!("warning: {name} has no publisher so far"),
        (count, _) => {
            format!("warning: {name} is silent so far; it has {}", plural(count, "publisher"))
        }
    }
}

/// What to check where nothing was heard.
fn nothing(recorder: &Recorder, environment: &Environment, passed: Duration) -> String {
    let topics: Vec<_> = recorder.topics().iter().map(silent).collect();
    let silent = topics.join("; ").replace("warning: ", "").replace(" so far", "");
    let Environment { domain, range, .. } = environment;
    let range = format!("{range:?}").to_uppercase();
    let others: Vec<_> = recorder
        .others()
        .into_iter()
        .map(|(name, type_name)| format!("{name} ({type_name})"))
        .collect();
    let seen = match others.len() {
        0 => "no other topic has a publisher either: check that the robot's driver runs, that \
              ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE are the same there as here, and that \
              its middleware is DDS"
            .to_owned(),
        _ => format!(
            "others have publishers: {}. Name one with --joint-states or --topic",
            others.join(", ")
        ),
    };
    format!(
        "nothing was heard in {:.1} s, so there is no file: {silent}. Domain {domain}, range {range}; \
         {seen}",
        passed.as_secs_f64()
    )
}

fn offered(offer: &Offer) -> OfferedQos {
    let Offer { reliable, transient_local } = *offer;
    OfferedQos { reliable, transient_local }
}

/// The definition of a type in a ROS installation that is sourced.
fn installed(name: &str) -> Option<String> {
    let (package, message) = name.split_once('/')?;
    let prefixes = std::env::var_os("AMENT_PREFIX_PATH")?;
    let file = Path::new("share").join(package).join("msg").join(format!("{message}.msg"));
    std::env::split_paths(&prefixes).find_map(|prefix| {
        let text = std::fs::read_to_string(prefix.join(&file)).ok()?;
        // An empty one would be taken for none.
        Some(if text.trim().is_empty() { "# It has no fields.\n".into() } else { text })
    })
}

/// A line that changes on a terminal, and lines now and then elsewhere.
struct Status {
    bar: Option<ProgressBar>,
    shown: Duration,
}

impl Status {
    fn new() -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let style = ProgressStyle::with_template("{spinner} {msg}");
            ProgressBar::new_spinner().with_style(style.expect("the template is one"))
        });
        Self { bar, shown: Duration::ZERO }
    }

    fn say(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{line}")),
            None => eprintln!("{line}"),
        }
    }

    fn show(&mut self, passed: Duration, line: &str) {
        match &self.bar {
            Some(bar) => {
                bar.set_message(line.to_owned());
                bar.tick();
            }
            None if passed >= self.shown + EVERY_UNWATCHED => {
                self.shown = passed;
                eprintln!("{line}");
            }
            None => {}
        }
    }

    fn end(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
