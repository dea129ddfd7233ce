//! Parameters with descriptors: what `rcl_interfaces`' six services answer.
//!
//! A parameter here is a view: its owner lists all of them with their present values, and sets
//! one by name. What an event reports is the difference of two lists, so no change goes unseen,
//! whichever way it came.

use ros2_client::ParameterValue;
use ros2_client::builtin_interfaces::Time;
use ros2_client::parameters::raw;
use ros2_client::rcl_interfaces::ListParametersResult;

/// The values that a parameter may take.
#[derive(Debug, Clone, PartialEq)]
pub enum Range {
    /// Any of its type.
    Any,
    /// Whole numbers, both ends included.
    Integer(i64, i64),
    /// Decimals, both ends included.
    Double(f64, f64),
    /// These texts.
    OneOf(&'static [&'static str]),
}

/// A parameter as it is now.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// Name, with dots between its levels.
    pub name: String,
    /// What it is for, with its unit.
    pub description: String,
    /// What it may be.
    pub range: Range,
    /// Whether it is fixed at start.
    pub read_only: bool,
    /// The present value, whose type is the parameter's.
    pub value: ParameterValue,
}

impl Parameter {
    /// The value that a request means for this parameter: of its type, and in its range. Whole
    /// numbers are taken for decimals, and YAML's older words for booleans.
    ///
    /// # Errors
    /// The reason, for a person.
    pub fn accept(&self, value: ParameterValue) -> Result<ParameterValue, String> {
        use ParameterValue as P;
        let name = &self.name;
        let value = match (&self.value, value) {
            (P::Double(_), P::Integer(value)) => P::Double(value as f64),
            (P::DoubleArray(_), P::IntegerArray(values)) => {
                P::DoubleArray(values.into_iter().map(|v| v as f64).collect())
            }
            (P::Boolean(_), P::String(word)) => match word.as_str() {
                "yes" | "Yes" | "YES" | "on" | "On" | "ON" | "y" | "Y" => P::Boolean(true),
                "no" | "No" | "NO" | "off" | "Off" | "OFF" | "n" | "N" => P::Boolean(false),
                _ => P::String(word),
            },
            // `ros2 param set` can't know the type of an empty array, and says booleans.
            (P::DoubleArray(_), value) if is_empty_array(&value) => P::DoubleArray(vec![]),
            (_, value) => value,
        };
        if value == P::NotSet {
            return Err(format!("{name} can't be removed"));
        }
        let (wanted, found) = (type_name(&self.value), type_name(&value));
        if wanted != found {
            return Err(format!("{name} is {wanted}, not {found}"));
        }
        match (&self.range, &value) {
            (Range::Integer(lower, upper), P::Integer(v)) if !(lower..=upper).contains(&v) => {
                Err(format!("{name} = {v} is outside [{lower}, {upper}]"))
            }
            (Range::Double(lower, upper), P::Double(v)) if !(lower..=upper).contains(&v) => {
                Err(format!("{name} = {v} is outside [{lower}, {upper}]"))
            }
            (Range::OneOf(words), P::String(v)) if !words.contains(&v.as_str()) => {
                Err(format!("{name} = {v:?} is none of {}", words.join(", ")))
            }
            _ => Ok(value),
        }
    }

    fn descriptor(&self) -> raw::ParameterDescriptor {
        let mut descriptor = raw::ParameterDescriptor {
            description: self.description.clone(),
            read_only: self.read_only,
            r#type: self.value.to_parameter_type() as u8,
            ..unknown(&self.name)
        };
        match self.range {
            Range::Any => {}
            // Whole numbers have the step 1; decimals have none, as any value is taken.
            Range::Integer(from_value, to_value) => {
                descriptor.integer_range =
                    vec![raw::IntegerRange { from_value, to_value, step: 1 }];
            }
            Range::Double(from_value, to_value) => {
                descriptor.floating_point_range =
                    vec![raw::FloatingPointRange { from_value, to_value, step: 0.0 }];
            }
            Range::OneOf(words) => {
                descriptor.additional_constraints = format!("one of {}", words.join(", "));
                // Tools that show the description alone offer a field for any text.
                descriptor.description =
                    format!("{}: {}", descriptor.description, words.join(", "));
            }
        }
        descriptor
    }
}

/// The parameter of this name.
pub fn find<'a>(parameters: &'a [Parameter], name: &str) -> Option<&'a Parameter> {
    parameters.iter().find(|p| p.name == name)
}

/// The values of these names; not set where there is no such parameter.
pub fn get(parameters: &[Parameter], names: &[String]) -> Vec<raw::ParameterValue> {
    let value = |name: &String| match find(parameters, name) {
        Some(parameter) => parameter.value.clone().into(),
        None => ParameterValue::NotSet.into(),
    };
    names.iter().map(value).collect()
}

/// The types of these names; not set where there is no such parameter.
pub fn types(parameters: &[Parameter], names: &[String]) -> Vec<u8> {
    get(parameters, names).into_iter().map(|value| value.ptype).collect()
}

/// The descriptors of these names; one without a type where there is no such parameter.
pub fn describe(parameters: &[Parameter], names: &[String]) -> Vec<raw::ParameterDescriptor> {
    let descriptor = |name: &String| match find(parameters, name) {
        Some(parameter) => parameter.descriptor(),
        None => unknown(name),
    };
    names.iter().map(descriptor).collect()
}

/// The names that equal a prefix or lie at most `depth` levels below one, and the levels that
/// hold them. No prefix means the root; depth 0 means all levels.
pub fn list(parameters: &[Parameter], prefixes: &[String], depth: u64) -> ListParametersResult {
    let within = |rest: &str| depth == 0 || (rest.split('.').count() as u64) <= depth;
    let wanted = |name: &str| match prefixes {
        [] => within(name),
        _ => prefixes.iter().any(|prefix| match name.strip_prefix(prefix.as_str()) {
            Some("") => true,
            Some(rest) => rest.strip_prefix('.').is_some_and(within),
            None => false,
        }),
    };
    let names = parameters.iter().map(|p| p.name.clone()).filter(|name| wanted(name));
    let names: Vec<String> = names.collect();
    let mut prefixes: Vec<String> =
        names.iter().filter_map(|n| n.rsplit_once('.')).map(|(level, _)| level.into()).collect();
    prefixes.sort();
    prefixes.dedup();
    ListParametersResult { names, prefixes }
}

/// What changed from one list to another, if anything did.
pub fn event(
    before: &[Parameter],
    after: &[Parameter],
    stamp: Time,
    node: &str,
) -> Option<raw::ParameterEvent> {
    let message =
        |p: &Parameter| raw::Parameter { name: p.name.clone(), value: p.value.clone().into() };
    let new_parameters: Vec<_> =
        after.iter().filter(|p| find(before, &p.name).is_none()).map(message).collect();
    let changed = |p: &&Parameter| find(before, &p.name).is_some_and(|old| old.value != p.value);
    let changed_parameters: Vec<_> = after.iter().filter(changed).map(message).collect();
    let deleted_parameters: Vec<_> =
        before.iter().filter(|p| find(after, &p.name).is_none()).map(message).collect();
    let nothing =
        new_parameters.is_empty() && changed_parameters.is_empty() && deleted_parameters.is_empty();
    (!nothing).then(|| raw::ParameterEvent {
        stamp,
        node: node.into(),
        new_parameters,
        changed_parameters,
        deleted_parameters,
    })
}

/// The known name that is nearest to an unknown one, as a question to the user.
pub fn suggestion(parameters: &[Parameter], name: &str) -> String {
    let nearest = parameters
        .iter()
        .map(|p| (strsim::normalized_damerau_levenshtein(&p.name, name), p.name.as_str()))
        .max_by(|a, b| a.0.total_cmp(&b.0));
    match nearest {
        Some((likeness, known)) if likeness > 0.5 => format!("did you mean {known}?"),
        _ => "`ros2 param list` shows those that there are".into(),
    }
}

/// The descriptor of a parameter that there is not.
fn unknown(name: &str) -> raw::ParameterDescriptor {
    raw::ParameterDescriptor {
        name: name.into(),
        r#type: raw::ParameterType::NOT_SET,
        description: String::new(),
        additional_constraints: String::new(),
        read_only: false,
        dynamic_typing: false,
        floating_point_range: Vec::new(),
        integer_range: Vec::new(),
    }
}

fn is_empty_array(value: &ParameterValue) -> bool {
    match value {
        ParameterValue::ByteArray(values) => values.is_empty(),
        ParameterValue::BooleanArray(values) => values.is_empty(),
        ParameterValue::StringArray(values) => values.is_empty(),
        _ => false,
    }
}

/// A value's type, in words.
fn type_name(value: &ParameterValue) -> &'static str {
    match value {
        ParameterValue::NotSet => "not set",
        ParameterValue::Boolean(_) => "a boolean",
        ParameterValue::Integer(_) => "a whole number",
        ParameterValue::Double(_) => "a decimal",
        ParameterValue::String(_) => "a string",
        ParameterValue::ByteArray(_) => "an array of bytes",
        ParameterValue::BooleanArray(_) => "an array of booleans",
        ParameterValue::IntegerArray(_) => "an array of whole numbers",
        ParameterValue::DoubleArray(_) => "an array of decimals",
        ParameterValue::StringArray(_) => "an array of strings",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ParameterValue as P;

    fn parameter(name: &str, range: Range, value: P) -> Parameter {
        let description = format!("what {name} is for");
        Parameter { name: name.into(), description, range, read_only: false, value }
    }

    fn parameters() -> Vec<Parameter> {
        vec![
            parameter("manner.mode", Range::OneOf(&["fixed", "prior"]), P::String("fixed".into())),
            parameter("manner.pace.low", Range::Double(-3.0, 3.0), P::Double(0.0)),
            parameter("publish", Range::Any, P::Boolean(false)),
            parameter("sample.tries", Range::Integer(1, 9), P::Integer(5)),
            parameter("start", Range::Any, P::DoubleArray(vec![])),
        ]
    }

    fn names(names: &[&str]) -> Vec<String> {
        names.iter().map(|n| (*n).to_owned()).collect()
    }

    fn accept(name: &str, value: P) -> Result<P, String> {
        find(&parameters(), name).unwrap().accept(value)
    }

    #[test]
    fn a_whole_number_is_taken_for_a_decimal_but_not_the_other_way_round() {
        assert_eq!(accept("manner.pace.low", P::Integer(1)), Ok(P::Double(1.0)));
        let error = accept("sample.tries", P::Double(3.0)).unwrap_err();
        assert_eq!(error, "sample.tries is a whole number, not a decimal");
    }

    #[test]
    fn the_older_words_of_yaml_are_booleans_where_one_is_wanted() {
        assert_eq!(accept("publish", P::String("on".into())), Ok(P::Boolean(true)));
        assert!(accept("publish", P::String("maybe".into())).is_err());
    }

    #[test]
    fn an_empty_array_has_the_type_that_is_wanted() {
        for empty in [P::StringArray(vec![]), P::BooleanArray(vec![]), P::IntegerArray(vec![])] {
            assert_eq!(accept("start", empty), Ok(P::DoubleArray(vec![])));
        }
        assert_eq!(accept("start", P::IntegerArray(vec![1])), Ok(P::DoubleArray(vec![1.0])));
        assert!(accept("start", P::StringArray(vec!["a".into()])).is_err());
    }

    #[test]
    fn values_outside_the_range_are_refused_with_the_range() {
        let refused = |name, value| accept(name, value).unwrap_err();
        assert_eq!(refused("sample.tries", P::Integer(0)), "sample.tries = 0 is outside [1, 9]");
        assert_eq!(
            refused("manner.pace.low", P::Double(f64::NAN)),
            "manner.pace.low = NaN is outside [-3, 3]"
        );
        assert_eq!(
            refused("manner.mode", P::String("x".into())),
            "manner.mode = \"x\" is none of fixed, prior"
        );
        assert_eq!(refused("publish", P::NotSet), "publish can't be removed");
    }

    #[test]
    fn listing_goes_by_prefix_and_depth() {
        let list = |prefixes: &[&str], depth| list(&parameters(), &names(prefixes), depth);
        assert_eq!(list(&[], 0).names.len(), 5);
        assert_eq!(list(&[], 0).prefixes, ["manner", "manner.pace", "sample"]);
        assert_eq!(list(&[], 1).names, ["publish", "start"]);
        assert_eq!(list(&["manner"], 1).names, ["manner.mode"]);
        assert_eq!(list(&["manner"], 0).names, ["manner.mode", "manner.pace.low"]);
        assert_eq!(list(&["publish"], 1).names, ["publish"]);
        assert!(list(&["man"], 0).names.is_empty());
    }

    #[test]
    fn descriptors_tell_type_range_and_purpose() {
        let names = names(&["sample.tries", "manner.pace.low", "manner.mode", "nothing"]);
        let found = describe(&parameters(), &names);
        assert_eq!(found[0].r#type, raw::ParameterType::INTEGER);
        assert_eq!(found[0].description, "what sample.tries is for");
        assert_eq!(
            (found[0].integer_range[0].from_value, found[0].integer_range[0].to_value),
            (1, 9)
        );
        assert_eq!(found[1].floating_point_range[0].to_value, 3.0);
        assert_eq!(found[2].additional_constraints, "one of fixed, prior");
        assert_eq!((found[3].name.as_str(), found[3].r#type), ("nothing", 0));
        assert_eq!(types(&parameters(), &names), [2, 3, 4, 0]);
    }

    #[test]
    fn an_event_holds_what_is_new_changed_and_gone() {
        let before = parameters();
        let mut after = parameters();
        assert!(event(&before, &after, Time::ZERO, "/n").is_none());
        after[3].value = P::Integer(6);
        after[0].name = "manner.kind".into();
        let event = event(&before, &after, Time::ZERO, "/n").unwrap();
        let of = |list: Vec<raw::Parameter>| list.into_iter().map(|p| p.name).collect::<Vec<_>>();
        assert_eq!(of(event.new_parameters), ["manner.kind"]);
        assert_eq!(of(event.changed_parameters), ["sample.tries"]);
        assert_eq!(of(event.deleted_parameters), ["manner.mode"]);
    }

    #[test]
    fn a_misspelled_name_is_recognised() {
        assert_eq!(suggestion(&parameters(), "sample.trys"), "did you mean sample.tries?");
        assert!(suggestion(&parameters(), "qqqqqq").contains("ros2 param list"));
    }
}
