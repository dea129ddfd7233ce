//! The server: takes tasks, manners and settings, and answers requests with checked motions.

use std::cmp::Ordering;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::thread;

use nalgebra::Isometry3;
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;

use crate::kinematics::timing::Scales;
use crate::parameters::{MannerParameters, ParameterError, TaskLocation, TaskParameters};
use crate::serving::mirrored::mirrored;
use crate::serving::motion::{Effort, Failure, MOST_POINTS, Order, Start, could_be_followed};
use crate::serving::{
    Description, ErrorCode, GivenLocation, MAX_COUNT, MannerMode, OutOfDistribution, RankBy,
    Refusal, Robot, SPEEDS, Sample, SampleReply, SampleRequest, ServedModel, Settings, StartPolicy,
};

/// The least and the largest share of the limits that may be used.
const SCALES: [f64; 2] = [0.01, 1.0];

/// Draws whose ways are looked for thoroughly when none was found quickly.
const MOST_THOROUGH: usize = 5;

/// Most threads that one request is answered on.
const MOST_THREADS: usize = 8;

/// A location as it was given, and when.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Given {
    xy: [f64; 2],
    at_secs: f64,
}

/// The state and the rules of the node. Clones are cheap and share the model, the robot and the
/// stream of seeds: a caller samples on a clone while others change the original.
#[derive(Debug, Clone)]
pub struct PrimitiveServer {
    model: Arc<ServedModel>,
    robot: Arc<Robot>,
    settings: Settings,
    /// One for each location of the model's task space.
    given: Vec<Option<Given>>,
    defaults: Vec<Option<[f64; 2]>>,
    manner: MannerParameters,
    /// Which manner parameters an operator has set; the others are at the prior's mean.
    manner_set: Vec<bool>,
    /// Where each joint was last, and when.
    joints: Vec<Option<(f64, f64)>>,
    /// Seeds handed out since `settings.seed` was set.
    seeds_drawn: Arc<AtomicU64>,
}

impl PrimitiveServer {
    /// A server of `model` on `robot`.
    ///
    /// # Errors
    /// [`ErrorCode::RobotMismatch`] when the model was made for another arm, and
    /// [`ErrorCode::BadRequest`] for settings outside their ranges.
    pub fn new(
        model: Arc<ServedModel>,
        robot: Arc<Robot>,
        settings: Settings,
    ) -> Result<Self, Refusal> {
        let model = made_for(model, &robot)?;
        let locations = model.space().locations().len();
        Ok(Self {
            manner: MannerParameters::mean(model.primitive.manner_space()),
            manner_set: vec![false; model.primitive.manner_space().dim()],
            given: vec![None; locations],
            defaults: vec![None; locations],
            settings: settings.checked()?,
            joints: vec![None; robot.chain.dof()],
            seeds_drawn: Arc::default(),
            model,
            robot,
        })
    }

    /// The model that is served.
    pub fn model(&self) -> &ServedModel {
        &self.model
    }

    /// The robot that it is served on.
    pub fn robot(&self) -> &Robot {
        &self.robot
    }

    /// The settings.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Changes the settings; a new seed restarts the stream of seeds.
    ///
    /// # Errors
    /// [`ErrorCode::BadRequest`] for a value outside its range; then the old settings stay.
    pub fn set_settings(&mut self, settings: Settings) -> Result<(), Refusal> {
        let settings = settings.checked()?;
        if settings.seed != self.settings.seed {
            self.seeds_drawn = Arc::default();
        }
        self.settings = settings;
        Ok(())
    }

    /// The location that a goal pose sets: the first of the task space.
    pub fn goal_location(&self) -> &str {
        &self.model.space().locations()[0].name
    }

    /// Sets a location of the task, in the base frame, received at `now_secs` on a clock that
    /// never goes back.
    ///
    /// # Errors
    /// [`ErrorCode::TaskUnknown`], [`ErrorCode::NotFinite`].
    pub fn set_location(&mut self, name: &str, xy: [f64; 2], now_secs: f64) -> Result<(), Refusal> {
        let index = self.location_index(name)?;
        check_finite(name, xy)?;
        self.given[index] = Some(Given { xy, at_secs: now_secs });
        Ok(())
    }

    /// Sets what a location is while nothing else was given; `None` for nothing.
    ///
    /// # Errors
    /// [`ErrorCode::TaskUnknown`], [`ErrorCode::NotFinite`].
    pub fn set_default_location(
        &mut self,
        name: &str,
        xy: Option<[f64; 2]>,
    ) -> Result<(), Refusal> {
        let index = self.location_index(name)?;
        if let Some(xy) = xy {
            check_finite(name, xy)?;
        }
        self.defaults[index] = xy;
        Ok(())
    }

    /// Forgets what was heard: the task's locations, and where the arm is. Settings and defaults stay.
    pub fn forget(&mut self) {
        self.given.fill(None);
        self.joints.fill(None);
    }

    /// Takes note of where joints are by name (rad, or m), heard at `now_secs` on a clock that never goes back.
    /// Joints of others may be among them, and the arm's may come in several messages; what is not finite is
    /// not heard.
    pub fn set_joint_state<'a>(
        &mut self,
        named: impl Iterator<Item = (&'a str, f64)>,
        now_secs: f64,
    ) {
        for (name, position) in named.filter(|(_, position)| position.is_finite()) {
            let joint = self.robot.chain.joints().iter().position(|joint| joint.name == name);
            if let Some(joint) = joint {
                self.joints[joint] = Some((position, now_secs));
            }
        }
    }

    /// Height of the table in the base frame (m), if there is one.
    pub fn table_height_m(&self) -> Option<f64> {
        self.robot.hull.table_height_m()
    }

    /// Changes what must not be touched: the table's height in the base frame (m), none without a table, and the
    /// distance that is left (m).
    ///
    /// # Errors
    /// [`ErrorCode::BadRequest`] for a number outside its range; then nothing changes.
    pub fn set_surroundings(
        &mut self,
        table_height_m: Option<f64>,
        clearance_m: f64,
    ) -> Result<(), Refusal> {
        if !(0.0..=1.0).contains(&clearance_m) {
            return Err(bad_request(format!(
                "collision.clearance_m = {clearance_m} is outside [0, 1]; the old value stays"
            )));
        }
        if let Some(height) = table_height_m.filter(|height| !height.is_finite()) {
            return Err(bad_request(format!(
                "collision.table_height_m = {height} is no height; the old value stays"
            )));
        }
        let mut robot = Robot::clone(&self.robot);
        robot.hull = robot.hull.with_table(table_height_m);
        robot.clearance_m = clearance_m;
        self.robot = Arc::new(robot);
        Ok(())
    }

    /// The first location of the task that a request for these would not find: neither among
    /// them, nor set, nor a default.
    pub fn missing_location(&self, asked: &[GivenLocation]) -> Option<&TaskLocation> {
        let known = self.given.iter().zip(&self.defaults);
        let locations = self.model.space().locations().iter().zip(known);
        locations
            .filter(|(_, (given, default))| given.is_none() && default.is_none())
            .map(|(location, _)| location)
            .find(|location| asked.iter().all(|a| a.name != location.name))
    }

    /// The manner that is set, in standard deviations of the prior.
    pub fn manner(&self) -> &[f64] {
        self.manner.values()
    }

    /// Sets manner parameters by name; the others stay, or go back to the prior's mean with
    /// `reset`.
    ///
    /// # Errors
    /// [`ErrorCode::BadRequest`] for lists of different lengths or a name that stands twice,
    /// [`ErrorCode::MannerUnknown`], [`ErrorCode::MannerRange`], [`ErrorCode::NotFinite`]; then
    /// nothing changes.
    pub fn set_manner(
        &mut self,
        names: &[String],
        values: &[f64],
        reset: bool,
    ) -> Result<(), Refusal> {
        let dim = self.manner_set.len();
        let (mut manner, mut set) = match reset {
            true => (vec![0.0; dim], vec![false; dim]),
            false => (self.manner.values().to_vec(), self.manner_set.clone()),
        };
        for (index, value) in self.fixed_manner(names, values)? {
            manner[index] = value;
            set[index] = true;
        }
        self.manner = MannerParameters::new(self.model.primitive.manner_space(), manner)
            .map_err(manner_refusal)?;
        self.manner_set = set;
        Ok(())
    }

    /// Serves another model from now on. Locations and manner parameters that both models have
    /// keep their values.
    ///
    /// # Errors
    /// [`ErrorCode::RobotMismatch`]; then the old model stays.
    pub fn load_model(&mut self, model: Arc<ServedModel>) -> Result<(), Refusal> {
        let model = made_for(model, &self.robot)?;
        let (old, new) = (self.model.space(), model.space());
        let kept = new.locations().iter().map(|l| old.location_index(&l.name));
        let (given, defaults) = kept
            .map(|old| (old.and_then(|i| self.given[i]), old.and_then(|i| self.defaults[i])))
            .unzip();
        let old_space = self.model.primitive.manner_space();
        let new_space = model.primitive.manner_space();
        let kept = new_space.axes().iter().map(|axis| match old_space.index(&axis.name) {
            Ok(i) => (self.manner.values()[i].clamp(axis.lower, axis.upper), self.manner_set[i]),
            Err(_) => (0.0, false),
        });
        let (manner, set) = kept.unzip();
        let manner = MannerParameters::new(new_space, manner).map_err(manner_refusal)?;
        (self.given, self.defaults, self.model) = (given, defaults, model);
        (self.manner, self.manner_set) = (manner, set);
        Ok(())
    }

    /// What is served.
    pub fn describe(&self) -> Description {
        let model = &*self.model;
        let intervals = model.space().intervals();
        Description {
            model_id: model.model_id.clone(),
            method: model.method.clone(),
            primitive: model.task.name().into(),
            task_names: model.space().value_names(),
            task_lower: intervals.iter().map(|i| i.lower).collect(),
            task_upper: intervals.iter().map(|i| i.upper).collect(),
            manner: model.primitive.manner_space().axes().to_vec(),
            manner_values: self.manner.values().to_vec(),
            evaluation_json: model.evaluation_json.clone(),
            robot: self.robot.name.clone(),
            joint_names: self.robot.chain.joint_names(),
            synthetic_data: model.synthetic_data,
            mirrored: model.mirrored,
        }
    }

    /// Answers a request at `now_secs` of the clock that [`Self::set_location`] uses.
    ///
    /// Every sample of the answer has passed every check; when there are fewer than asked for,
    /// the refusal says why.
    pub fn sample(&self, request: &SampleRequest, now_secs: f64) -> SampleReply {
        let mut samples = Vec::new();
        let refusal = self.fill(&mut samples, request, now_secs).err();
        rank(&mut samples, request.rank_by);
        SampleReply { samples, refusal, model_id: self.model.model_id.clone() }
    }

    fn fill(
        &self,
        samples: &mut Vec<Sample>,
        request: &SampleRequest,
        now_secs: f64,
    ) -> Result<(), Refusal> {
        let count = request.count.max(1);
        if count > MAX_COUNT {
            return Err(bad_request(format!(
                "{count} samples asked for; one request gives at most {MAX_COUNT}; ask again with \
                 another seed for more"
            )));
        }
        let w = self.task(&request.task, now_secs)?;
        let fixed = self.fixed_manner(&request.manner_names, &request.manner_values)?;
        let mut warnings = Vec::new();
        let familiarity = self.check_familiar(&w, request, &mut warnings)?;
        let order = self.order(request, w, familiarity, warnings, now_secs)?;
        let first_seed = match request.seed {
            0 => self.next_seed(count),
            seed => seed,
        };
        // Seed 0 means the node's own, so it is never a sample's.
        let seeds: Vec<_> =
            (0..u64::from(count)).map(|i| first_seed.wrapping_add(i).max(1)).collect();
        // Samples share the cores, or else the draws of the only one do.
        let (for_samples, for_draws) = if seeds.len() > 1 { (cores(), 1) } else { (1, cores()) };
        let draw = |seed: &u64| self.draw(request, &fixed, &order, *seed, for_draws);
        for sample in at_once(&seeds, for_samples, draw) {
            samples.push(sample?);
        }
        Ok(())
    }

    /// Draws manners until a motion passes every check: first with a quick look for each one's way, then a
    /// thorough one for those that came nearest.
    fn draw(
        &self,
        request: &SampleRequest,
        fixed: &[(usize, f64)],
        order: &Order,
        seed: u64,
        threads: usize,
    ) -> Result<Sample, Refusal> {
        let manners: Vec<_> = self.manners(request, fixed, seed).collect::<Result<_, _>>()?;
        let carry_out =
            |h: &MannerParameters, effort| order.carry_out(&self.model, &self.robot, h, effort);
        let mut failures: Vec<(usize, Failure)> = Vec::new();
        if manners.len() > 1 {
            // The first mostly passes; from then on as many at once as there are threads. What counts is their
            // order, so that the answer does not depend on how many that are.
            let (first, rest) = manners.split_at(1);
            for some in std::iter::once(first).chain(rest.chunks(threads)) {
                let outcomes = at_once(some, threads, |h| carry_out(h, Effort::Quick));
                for outcome in outcomes {
                    match outcome {
                        Ok(sample) => {
                            let tries = failures.len() as u32 + 1;
                            let mean = failures.first().map(|(_, failure)| failure);
                            return Ok(self.told(request, mean, Sample { seed, tries, ..sample }));
                        }
                        Err(failure) => failures.push((failures.len(), failure)),
                    }
                }
            }
            // A stable sort, so that the first of equals is tried first.
            failures.sort_by(|(_, a), (_, b)| {
                b.nearness().partial_cmp(&a.nearness()).unwrap_or(Ordering::Equal)
            });
        }
        let tries = manners.len() as u32;
        let mut best: Option<Failure> = None;
        let nearest = failures.iter().map(|(i, _)| *i).chain((manners.len() == 1).then_some(0));
        for i in nearest.take(MOST_THOROUGH) {
            match carry_out(&manners[i], Effort::Thorough) {
                Ok(sample) => {
                    let mean = failures.iter().find(|(first, _)| *first == 0 && i > 0);
                    let mean = mean.map(|(_, failure)| failure);
                    return Ok(self.told(request, mean, Sample { seed, tries, ..sample }));
                }
                Err(failure) => best = Some(Failure::nearer(best, failure)),
            }
        }
        let failure = best.expect("at least one try");
        Err(match tries {
            1 => failure.refusal,
            _ => Refusal {
                message: format!(
                    "none of {tries} draws passed (sample.max_tries); the nearest: {}",
                    failure.refusal.message
                ),
                ..failure.refusal
            },
        })
    }

    /// A sample that tells where its manner was drawn though nobody asked for draws.
    fn told(&self, request: &SampleRequest, mean: Option<&Failure>, mut sample: Sample) -> Sample {
        if let (false, Some(mean)) = (self.draws(request), mean) {
            sample.warnings.push(format!(
                "the manner parameters that are not set were drawn, since their mean was refused: {}",
                mean.refusal.message
            ));
        }
        sample
    }

    /// Whether a request's manner is drawn from the prior.
    fn draws(&self, request: &SampleRequest) -> bool {
        request.sample_manner || self.settings.manner_mode == MannerMode::Prior
    }

    /// The manners to try, one after the other. What a request or an operator has set stays as it is; where a
    /// request does not ask for draws, the first try is at the prior's mean, and the manner parameters that
    /// nobody has set are drawn only if that fails.
    fn manners(
        &self,
        request: &SampleRequest,
        fixed: &[(usize, f64)],
        seed: u64,
    ) -> impl Iterator<Item = Result<MannerParameters, Refusal>> {
        let space = self.model.primitive.manner_space();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let draws = self.draws(request);
        let is_fixed = |index| fixed.iter().any(|(i, _)| *i == index);
        let is_free = |&index: &usize| !is_fixed(index) && (draws || !self.manner_set[index]);
        let free: Vec<usize> = (0..space.dim()).filter(is_free).collect();
        // With nothing left to draw, a second try would be the first again.
        let tries = if free.is_empty() { 1 } else { self.settings.max_tries };
        (1..=tries).map(move |attempt| {
            let mut h = self.manner.values().to_vec();
            if draws || attempt > 1 {
                let drawn = self.model.primitive.sample_manner(&mut rng);
                free.iter().for_each(|&index| h[index] = drawn.values()[index]);
            }
            for &(index, value) in fixed {
                h[index] = value;
            }
            MannerParameters::new(space, h).map_err(manner_refusal)
        })
    }

    /// Whether any of the motions that a request may be answered with could be followed point by point: each of
    /// its poses has a configuration, on its own and found from many starts, that is inside the limits and
    /// clear of what must not be touched. It takes much longer than an answer.
    ///
    /// # Errors
    /// A request that names what there is not; a task that is not known.
    pub fn could_be_followed(
        &self,
        request: &SampleRequest,
        now_secs: f64,
    ) -> Result<bool, Refusal> {
        let wished = self.wished(request, now_secs)?;
        Ok(wished.iter().any(|poses| could_be_followed(&self.robot, poses)))
    }

    /// The poses of the tip of each motion that a request may be answered with, whatever the arm makes of it.
    ///
    /// # Errors
    /// As [`Self::could_be_followed`].
    pub fn wished(
        &self,
        request: &SampleRequest,
        now_secs: f64,
    ) -> Result<Vec<Vec<Isometry3<f64>>>, Refusal> {
        let w = self.task(&request.task, now_secs)?;
        let fixed = self.fixed_manner(&request.manner_names, &request.manner_values)?;
        let order = self.order(request, w, 0.0, Vec::new(), now_secs)?;
        let manners = self.manners(request, &fixed, request.seed.max(1));
        manners.map(|h| Ok(order.wished(&self.model, &h?))).collect()
    }

    fn order(
        &self,
        request: &SampleRequest,
        w: TaskParameters,
        in_distribution_task: f64,
        mut warnings: Vec<String>,
        now_secs: f64,
    ) -> Result<Order, Refusal> {
        let chosen = |name: &str, asked: f64, set: f64, [lower, upper]: [f64; 2]| match asked {
            0.0 => Ok(set),
            _ if asked.is_nan() || asked.is_infinite() => {
                Err(Refusal::new(ErrorCode::NotFinite, format!("{name} is {asked}")))
            }
            _ if (lower..=upper).contains(&asked) => Ok(asked),
            _ => Err(bad_request(format!(
                "{name} = {asked} is outside [{lower}, {upper}]; 0 takes the node's setting, {set}"
            ))),
        };
        let Settings { velocity_scale, acceleration_scale, speed, .. } = self.settings;
        let velocity = chosen("velocity_scale", request.velocity_scale, velocity_scale, SCALES)?;
        let acceleration =
            chosen("acceleration_scale", request.acceleration_scale, acceleration_scale, SCALES)?;
        Ok(Order {
            w,
            in_distribution_task,
            tolerance_m: self.settings.tolerance_m,
            scales: Scales { velocity, acceleration },
            speed: chosen("speed", request.speed, speed, SPEEDS)?,
            rate_hz: self.rate(request.rate_hz)?,
            start: self.start(request, now_secs, &mut warnings)?,
            warnings,
        })
    }

    /// The rate that is asked for, if it makes a sensible number of points.
    fn rate(&self, rate_hz: f64) -> Result<Option<f64>, Refusal> {
        if rate_hz == 0.0 {
            return Ok(None);
        }
        if !rate_hz.is_finite() {
            return Err(Refusal::new(ErrorCode::NotFinite, format!("rate_hz is {rate_hz}")));
        }
        let points = rate_hz * self.model.duration_secs;
        if (2.0..=MOST_POINTS).contains(&points) {
            return Ok(Some(rate_hz));
        }
        Err(bad_request(format!(
            "rate_hz = {rate_hz} makes {points:.0} points of a motion of {:.1} s; 2 to \
             {MOST_POINTS} are served; choose a rate between {:.2} and {:.0}, or 0 for the model's",
            self.model.duration_secs,
            2.0 / self.model.duration_secs,
            MOST_POINTS / self.model.duration_secs,
        )))
    }

    /// Where the arm is before the motion, as the request says, or else the last joint states; and what the
    /// policy makes of it.
    fn start(
        &self,
        request: &SampleRequest,
        now_secs: f64,
        warnings: &mut Vec<String>,
    ) -> Result<Start, Refusal> {
        let policy = request.start_policy.unwrap_or(self.settings.start_policy);
        let positions = match request.start.as_slice() {
            [] if policy == StartPolicy::Ignore => return Ok(Start::Anywhere),
            [] => match self.present(now_secs) {
                Ok(positions) => positions,
                Err(refusal) if policy == StartPolicy::Refuse || request.is_driven => {
                    return Err(refusal);
                }
                Err(refusal) => {
                    let why = refusal.message;
                    warnings.push(format!(
                        "no joint states: the trajectory starts at its own first point ({why})"
                    ));
                    return Ok(Start::Anywhere);
                }
            },
            named => self.positions(named)?,
        };
        Ok(match policy {
            StartPolicy::Approach => Start::Approach(self.inside(positions)?),
            StartPolicy::Refuse => Start::Near(positions, self.settings.start_tolerance_rad),
            StartPolicy::Ignore => Start::Anywhere,
        })
    }

    /// Positions from which an approach can begin: those a bit outside their limits are pulled inside.
    fn inside(&self, mut positions: Vec<f64>) -> Result<Vec<f64>, Refusal> {
        let tolerance = self.settings.start_tolerance_rad;
        for (joint, position) in self.robot.chain.joints().iter().zip(&mut positions) {
            let inside = position.clamp(joint.lower, joint.upper);
            if (*position - inside).abs() > tolerance {
                return Err(Refusal::new(
                    ErrorCode::JointLimit,
                    format!(
                        "{} stands at {position:.3} rad, {:.3} rad beyond its limit, of which \
                         start.tolerance_rad allows {tolerance:.3}; bring it back first",
                        joint.name,
                        (*position - inside).abs()
                    ),
                ));
            }
            *position = inside;
        }
        Ok(positions)
    }

    /// Where the arm is, by joint states that are not too old.
    fn present(&self, now_secs: f64) -> Result<Vec<f64>, Refusal> {
        let stale = |message: String| Err(Refusal::new(ErrorCode::StaleJointState, message));
        let limit = self.settings.start_max_age_secs;
        let heard = self.robot.chain.joints().iter().zip(&self.joints);
        let positions = heard.map(|(joint, heard)| match heard {
            None => {
                stale(format!("nothing was heard of {} so far; publish /joint_states", joint.name))
            }
            Some((_, at_secs)) if now_secs - at_secs > limit => stale(format!(
                "what was heard of {} is {:.1} s old, start.max_age_s is {limit:.1} s; publish \
                 /joint_states",
                joint.name,
                now_secs - at_secs
            )),
            Some((position, _)) => Ok(*position),
        });
        positions.collect()
    }

    /// Named positions as a configuration of the arm.
    fn positions(&self, named: &[(String, f64)]) -> Result<Vec<f64>, Refusal> {
        let position = |joint: &String| match named.iter().find(|(name, _)| name == joint) {
            Some((_, position)) if position.is_finite() => Ok(*position),
            Some((_, position)) => Err(Refusal::new(
                ErrorCode::NotFinite,
                format!("start has {joint} at {position}; a finite number is needed"),
            )),
            None => Err(bad_request(format!(
                "start has no position of {joint}; it needs every joint of the arm, or none"
            ))),
        };
        self.robot.chain.joint_names().iter().map(position).collect()
    }

    /// The task of a request: its own locations, else the latest, else the defaults.
    fn task(&self, asked: &[GivenLocation], now_secs: f64) -> Result<TaskParameters, Refusal> {
        let space = self.model.space();
        let mut own = vec![None; space.locations().len()];
        for location in asked {
            let index = self.location_index(&location.name)?;
            check_finite(&location.name, location.xy)?;
            if own[index].replace(location.xy).is_some() {
                return Err(bad_request(format!(
                    "the task names {} twice; give each location once",
                    location.name
                )));
            }
        }
        let mut values = Vec::with_capacity(space.dim());
        for (index, location) in space.locations().iter().enumerate() {
            let xy = match (own[index], self.given[index], self.defaults[index]) {
                (Some(xy), _, _) => xy,
                (None, Some(given), _) => self.fresh(&location.name, given, now_secs)?,
                (None, None, Some(default)) => default,
                (None, None, None) => {
                    return Err(Refusal::new(
                        ErrorCode::NoTask,
                        format!(
                            "no {0} so far, and task.{0}.default is empty; publish {0}, put it \
                             into the request, or set the default",
                            location.name
                        ),
                    ));
                }
            };
            values.extend(xy);
        }
        TaskParameters::new(space, values)
            .map_err(|e| Refusal::new(ErrorCode::NotFinite, e.to_string()))
    }

    fn fresh(&self, name: &str, given: Given, now_secs: f64) -> Result<[f64; 2], Refusal> {
        let age = now_secs - given.at_secs;
        let limit = self.settings.max_age_secs;
        if limit > 0.0 && age > limit {
            return Err(Refusal::new(
                ErrorCode::StaleTask,
                format!(
                    "{name} is {age:.1} s old, task.max_age_s is {limit:.1} s; publish it again"
                ),
            ));
        }
        Ok(given.xy)
    }

    /// The manner parameters that names and values fix.
    fn fixed_manner(&self, names: &[String], values: &[f64]) -> Result<Vec<(usize, f64)>, Refusal> {
        if names.len() != values.len() {
            return Err(bad_request(format!(
                "{} manner names and {} values; give one value for each name",
                names.len(),
                values.len()
            )));
        }
        let space = self.model.primitive.manner_space();
        let mut fixed: Vec<(usize, f64)> = Vec::with_capacity(names.len());
        for (name, &value) in names.iter().zip(values) {
            let index = space.index(name).map_err(manner_refusal)?;
            if fixed.iter().any(|(i, _)| *i == index) {
                return Err(bad_request(format!("the manner parameter {name} is given twice")));
            }
            let axis = &space.axes()[index];
            if !value.is_finite() {
                return Err(manner_refusal(ParameterError::NotFinite {
                    name: name.clone(),
                    value,
                }));
            }
            if !(axis.lower..=axis.upper).contains(&value) {
                let (lower, upper) = (axis.lower, axis.upper);
                let name = name.clone();
                return Err(manner_refusal(ParameterError::Range { name, value, lower, upper }));
            }
            fixed.push((index, value));
        }
        Ok(fixed)
    }

    /// Whether a request's task is like those that were trained on.
    ///
    /// # Errors
    /// A task that is not known.
    pub fn is_familiar(&self, request: &SampleRequest, now_secs: f64) -> Result<bool, Refusal> {
        let w = self.task(&request.task, now_secs)?;
        Ok(self.unfamiliar(&w).is_none())
    }

    /// How a task is not like those that were trained on, if it is not.
    fn unfamiliar(&self, w: &TaskParameters) -> Option<String> {
        let space = self.model.space();
        let outside = space
            .value_names()
            .into_iter()
            .zip(space.intervals())
            .zip(w.values())
            .find(|((_, interval), value)| !interval.contains(**value));
        if let Some(((name, interval), value)) = outside {
            return Some(format!(
                "{name} = {value:.3} {} is outside the trained region, {:.3} to {:.3}",
                space.unit, interval.lower, interval.upper
            ));
        }
        (self.model.familiarity.task(w.values()) == 0.0).then(|| {
            let values: Vec<_> = w.values().iter().map(|v| format!("{v:.3}")).collect();
            format!(
                "the task ({}) lies further from the training tasks than any of them from the others",
                values.join(", ")
            )
        })
    }

    /// The share of training tasks further out than `w`.
    ///
    /// # Errors
    /// [`ErrorCode::OutOfDistribution`] for a task outside the trained region, where that is not
    /// allowed.
    fn check_familiar(
        &self,
        w: &TaskParameters,
        request: &SampleRequest,
        warnings: &mut Vec<String>,
    ) -> Result<f64, Refusal> {
        let share = self.model.familiarity.task(w.values());
        let Some(fact) = self.unfamiliar(w) else { return Ok(share) };
        if request.allow_out_of_distribution
            || self.settings.out_of_distribution == OutOfDistribution::Warn
        {
            warnings.push(fact);
            return Ok(share);
        }
        Err(Refusal::new(
            ErrorCode::OutOfDistribution,
            format!(
                "{fact}; choose a task inside, or set out_of_distribution to warn (the motion is \
                 still checked)"
            ),
        ))
    }

    fn location_index(&self, name: &str) -> Result<usize, Refusal> {
        let space = self.model.space();
        space.location_index(name).ok_or_else(|| {
            let known: Vec<_> = space.locations().iter().map(|l| l.name.as_str()).collect();
            Refusal::new(
                ErrorCode::TaskUnknown,
                format!("the model has no location {name:?}; it has {}", known.join(", ")),
            )
        })
    }

    /// The next `count` seeds of the node's stream; the first of them.
    fn next_seed(&self, count: u32) -> u64 {
        self.settings.seed.wrapping_add(self.seeds_drawn.fetch_add(u64::from(count), Relaxed))
    }
}

fn cores() -> usize {
    thread::available_parallelism().map_or(1, usize::from).min(MOST_THREADS)
}

/// What becomes of several things, in their order, worked out on so many threads.
fn at_once<I: Sync, T: Send>(items: &[I], threads: usize, work: impl Fn(&I) -> T + Sync) -> Vec<T> {
    let share = items.len().div_ceil(threads).max(1);
    if share >= items.len() {
        return items.iter().map(work).collect();
    }
    thread::scope(|scope| {
        let work = &work;
        let threads: Vec<_> = items
            .chunks(share)
            .map(|items| scope.spawn(move || items.iter().map(work).collect::<Vec<_>>()))
            .collect();
        let results = threads.into_iter().map(|thread| match thread.join() {
            Ok(results) => results,
            Err(panic) => std::panic::resume_unwind(panic),
        });
        results.flatten().collect()
    })
}

/// The model as it fits the robot: itself, or its mirror image for the other arm.
fn made_for(model: Arc<ServedModel>, robot: &Robot) -> Result<Arc<ServedModel>, Refusal> {
    let model = mirrored(&model, robot).map_or(model, Arc::new);
    match model.robot.check(&robot.chain) {
        Ok(()) => Ok(model),
        Err(mismatch) => Err(Refusal::new(
            ErrorCode::RobotMismatch,
            format!(
                "{mismatch}; serve a model that was trained for {}, or give the description of {}",
                robot.name, model.robot.name
            ),
        )),
    }
}

fn check_finite(name: &str, xy: [f64; 2]) -> Result<(), Refusal> {
    match xy.iter().all(|v| v.is_finite()) {
        true => Ok(()),
        false => Err(Refusal::new(
            ErrorCode::NotFinite,
            format!("{name} is ({}, {}); finite numbers are needed", xy[0], xy[1]),
        )),
    }
}

fn bad_request(message: String) -> Refusal {
    Refusal::new(ErrorCode::BadRequest, message)
}

fn manner_refusal(error: ParameterError) -> Refusal {
    let code = match error {
        ParameterError::Unknown { .. } => ErrorCode::MannerUnknown,
        ParameterError::Range { .. } => ErrorCode::MannerRange,
        ParameterError::NotFinite { .. } => ErrorCode::NotFinite,
        ParameterError::Length { .. } | ParameterError::Duplicate { .. } => ErrorCode::BadRequest,
    };
    Refusal::new(code, error.to_string())
}

/// Orders samples; equal ones stay as they were drawn.
fn rank(samples: &mut [Sample], by: RankBy) {
    let ascending = |cost: fn(&Sample) -> f64| {
        move |a: &Sample, b: &Sample| -> Ordering { cost(a).total_cmp(&cost(b)) }
    };
    match by {
        RankBy::Drawn => {}
        RankBy::Margin => samples.sort_by(ascending(|s| -s.joint_margin)),
        RankBy::Smoothness => samples.sort_by(ascending(|s| roughness(&s.joint_trajectory))),
        RankBy::Duration => samples.sort_by(ascending(|s| {
            s.joint_trajectory.times_secs.last().copied().unwrap_or_default()
        })),
    }
}

/// Mean square of the joints' accelerations, by differences of the velocities.
fn roughness(trajectory: &crate::trajectory::JointTrajectory) -> f64 {
    let mut sum = 0.0;
    for i in 1..trajectory.velocities.len() {
        let step = trajectory.times_secs[i] - trajectory.times_secs[i - 1];
        let pair = trajectory.velocities[i].iter().zip(&trajectory.velocities[i - 1]);
        sum += pair.map(|(b, a)| ((b - a) / step).powi(2)).sum::<f64>();
    }
    sum / trajectory.velocities.len() as f64
}
