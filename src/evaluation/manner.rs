//! What each manner parameter does: how the factors that a task measures change along it, over
//! random tasks and manners. The paper shows the same as traversals (figure 6).

use rand::{Rng, RngExt};

use super::leak::r2;
use crate::demonstrations::{Task, task::Factor};
use crate::parameters::{MannerAxis, MannerSpace, TaskParameters};
use crate::primitive::MannerConditioned;

/// Motions that the effects are measured on.
const MOTIONS: usize = 2000;
/// R2 from which a factor gives its name to a manner parameter. Above one half no two parameters
/// that are independent reach it for the same factor.
const DOMINATES_R2: f64 = 0.6;
/// The same where the parameter has no other effect worth telling, and no other parameter without a name
/// has this one: of a factor that hangs together with another, such as a pour's largest tilt with its
/// length, little is left to turn alone.
const SOLE_R2: f64 = 0.2;
/// R2 from which an effect is worth telling.
const NOTABLE_R2: f64 = 0.1;

/// Linear effect of one manner parameter on one factor.
#[derive(Debug, Clone, PartialEq)]
pub struct Effect {
    /// The factor; its value is the change per unit of the manner parameter.
    pub per_unit: Factor,
    /// Share of the factor's variance that the parameter alone explains.
    pub r2: f64,
}

/// The effects of each manner parameter, those of one parameter in the order of the task's
/// factors; measured on motions at random ones of `tasks` with manners from the prior. Motions that
/// do not show the task count for nothing.
///
/// # Panics
/// When `tasks` is empty.
pub fn manner_effects<M: MannerConditioned + ?Sized>(
    model: &M,
    task: &dyn Task,
    tasks: &[TaskParameters],
    duration_secs: f64,
    rng: &mut impl Rng,
) -> Vec<Vec<Effect>> {
    let (mut manners, mut measured) = (Vec::new(), Vec::new());
    for _ in 0..MOTIONS {
        let w = &tasks[rng.random_range(0..tasks.len())];
        let h = model.sample_manner(rng);
        let factors = task.factors(&model.decode(w, &h).motion(duration_secs));
        if !factors.is_empty() {
            manners.push(h);
            measured.push(factors);
        }
    }
    let factors = measured.first().cloned().unwrap_or_default();
    let effect = |axis: usize, place: usize| {
        let h: Vec<f64> = manners.iter().map(|h| h.values()[axis]).collect();
        let values: Vec<f64> = measured.iter().map(|f| f[place].value).collect();
        let (slope, r2) = regress(&h, &values);
        Effect { per_unit: Factor { value: slope, ..factors[place].clone() }, r2 }
    };
    let effects = |axis| (0..factors.len()).map(|place| effect(axis, place)).collect();
    (0..model.manner_space().dim()).map(effects).collect()
}

/// Slope and R2 of the least-squares line; no effect where either does not vary.
fn regress(x: &[f64], y: &[f64]) -> (f64, f64) {
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (mean_x, mean_y) = (mean(x), mean(y));
    let xx: f64 = x.iter().map(|x| (x - mean_x).powi(2)).sum();
    let xy: f64 = x.iter().zip(y).map(|(x, y)| (x - mean_x) * (y - mean_y)).sum();
    if xx <= 0.0 {
        return (0.0, 0.0);
    }
    let slope = xy / xx;
    let line: Vec<f64> = x.iter().map(|x| mean_y + slope * (x - mean_x)).collect();
    (slope, r2(&line, y).unwrap_or(0.0))
}

/// The manner space with what `effects` say: a parameter bears the name of the factor that it
/// dominates, at most one parameter for each factor, and tells its notable effects, the strongest
/// first; an inactive one has none. Order, signs and bounds stay.
///
/// # Panics
/// When `effects` and `active` do not have one entry for each axis.
pub fn described(space: &MannerSpace, effects: &[Vec<Effect>], active: &[bool]) -> MannerSpace {
    assert!(effects.len() == space.dim() && active.len() == space.dim(), "one entry an axis");
    let names = names(effects, active);
    let axis = |(i, axis): (usize, &MannerAxis)| MannerAxis {
        name: names[i].map_or_else(|| format!("h{}", i + 1), String::from),
        effect: if active[i] { sentence(&effects[i]) } else { "no effect".into() },
        ..axis.clone()
    };
    let axes = space.axes().iter().enumerate().map(axis).collect();
    MannerSpace::new(axes).expect("each factor names one axis at most")
}

/// The factor that names each axis: strongest pairs first, each factor and each axis once.
fn names<'a>(effects: &'a [Vec<Effect>], active: &[bool]) -> Vec<Option<&'a str>> {
    let mut pairs: Vec<(usize, &Effect)> =
        effects.iter().enumerate().flat_map(|(i, e)| e.iter().map(move |e| (i, e))).collect();
    pairs.retain(|(i, e)| active[*i] && e.r2 >= DOMINATES_R2);
    pairs.sort_by(|a, b| b.1.r2.total_cmp(&a.1.r2));
    let mut names = vec![None; effects.len()];
    for (i, effect) in pairs {
        let name = Some(&*effect.per_unit.name);
        if names[i].is_none() && !names.contains(&name) {
            names[i] = name;
        }
    }
    // What is left: one effect each, that no other parameter without a name has, too.
    let notable = |i: usize| -> Vec<&'a Effect> {
        let told = |e: &&Effect| active[i] && !e.per_unit.derived && e.r2 >= NOTABLE_R2;
        effects[i].iter().filter(told).collect()
    };
    let unnamed: Vec<usize> = (0..names.len()).filter(|i| names[*i].is_none()).collect();
    for &i in &unnamed {
        let [sole] = notable(i)[..] else { continue };
        let factor = &*sole.per_unit.name;
        let has_it = |other: &&usize| notable(**other).iter().any(|e| e.per_unit.name == factor);
        let alone = unnamed.iter().filter(has_it).count() == 1;
        if sole.r2 >= SOLE_R2 && alone && !names.contains(&Some(factor)) {
            names[i] = Some(factor);
        }
    }
    names
}

/// `+0.60 s above 70 degrees per unit (R2 0.91)`.
fn sentence(effects: &[Effect]) -> String {
    let mut notable: Vec<&Effect> = effects.iter().filter(|e| e.r2 >= NOTABLE_R2).collect();
    notable.sort_by(|a, b| b.r2.total_cmp(&a.r2));
    if notable.is_empty() {
        return "no linear effect on any factor".into();
    }
    let tell = |effect: &&Effect| {
        let Factor { unit, phrase, value, .. } = &effect.per_unit;
        let (unit, value) = match *unit {
            "1" => (String::new(), *value),
            "rad" => ("degrees ".into(), value.to_degrees()),
            unit => (format!("{unit} "), *value),
        };
        format!("{} {unit}{phrase} per unit (R2 {:.2})", two_digits(value), effect.r2)
    };
    notable.iter().map(tell).collect::<Vec<_>>().join(", ")
}

/// The value with its sign and two significant digits, four decimals at most.
fn two_digits(value: f64) -> String {
    let decimals = (1.0 - value.abs().log10().floor()).clamp(0.0, 4.0);
    format!("{value:+.*}", decimals as usize)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand::rngs::ChaCha8Rng;

    use super::*;
    use crate::demonstrations::arcs::ArcsTask;
    use crate::evaluation::oracles::{Oracle, exact_arc, exact_manner};
    use crate::primitive::MovementPrimitive;

    fn describe(oracle: &Oracle, active: [bool; 3]) -> Vec<(String, String)> {
        let task = |x| TaskParameters::new(oracle.task_space(), vec![x, 0.5]).unwrap();
        let tasks = [task(0.1), task(0.9)];
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let effects = manner_effects(oracle, &ArcsTask::default(), &tasks, 1.0, &mut rng);
        let space = described(oracle.manner_space(), &effects, &active);
        assert!(space.axes().iter().all(|a| (a.lower, a.upper) == (-3.0, 3.0)));
        space.axes().iter().map(|a| (a.name.clone(), a.effect.clone())).collect()
    }

    fn pairs(expected: [(&str, &str); 3]) -> Vec<(String, String)> {
        expected.iter().map(|(name, effect)| (name.to_string(), effect.to_string())).collect()
    }

    #[test]
    fn a_parameter_that_is_a_factor_bears_its_name_and_tells_its_slope() {
        assert_eq!(
            describe(&Oracle::exact(), [true; 3]),
            pairs([
                ("radius", "+0.050 radius per unit (R2 1.00)"),
                ("span", "+30 degrees span per unit (R2 1.00)"),
                ("start", "-30 degrees start angle per unit (R2 1.00)"),
            ])
        );
    }

    #[test]
    fn an_inactive_parameter_has_no_effect_and_no_name() {
        let described = describe(&Oracle::exact(), [true, false, true]);
        assert_eq!(described[1], ("h2".into(), "no effect".into()));
    }

    #[test]
    fn a_factor_that_two_parameters_share_names_neither() {
        let decode = |w: &[f64], h: &[f64]| {
            let mixed = 0.5 * (h[0] + h[1]);
            exact_arc(w, &[mixed, 0.0, 0.8 * h[2] + 0.1 * h[1]])
        };
        let described = describe(&Oracle::new(decode, exact_manner, -8.0), [true; 3]);
        assert_eq!([&described[0].0, &described[1].0], ["h1", "h2"]);
        assert!(described[0].1.starts_with("+0.025 radius per unit (R2 0.4"), "{described:?}");
        assert_eq!(described[2].0, "start");
    }

    #[test]
    fn what_another_factor_leaves_of_one_names_a_parameter_that_does_nothing_else() {
        // The span follows the radius for the most part; the second parameter is the rest of it.
        let decode = |w: &[f64], h: &[f64]| exact_arc(w, &[h[0], 0.85 * h[0] + 0.5 * h[1], h[2]]);
        let described = describe(&Oracle::new(decode, exact_manner, -8.0), [true; 3]);
        assert_eq!([&described[0].0, &described[1].0], ["radius", "span"], "{described:?}");
        assert!(described[1].1.starts_with("+15 degrees span per unit (R2 0.2"), "{described:?}");
    }

    #[test]
    fn a_parameter_that_bends_a_factor_both_ways_has_no_linear_effect() {
        let decode = |w: &[f64], h: &[f64]| exact_arc(w, &[h[0].abs(), h[1], h[2]]);
        let described = describe(&Oracle::new(decode, exact_manner, -8.0), [true; 3]);
        assert_eq!(described[0], ("h1".into(), "no linear effect on any factor".into()));
    }

    #[test]
    fn numbers_are_told_with_two_digits() {
        let told = [0.6, -0.054, 12.3, 240.0, 0.0].map(two_digits);
        assert_eq!(told, ["+0.60", "-0.054", "+12", "+240", "+0.0000"]);
    }
}
