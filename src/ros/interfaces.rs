//! The interfaces that the node speaks: what they are made of, and the hash by which others tell whether they
//! mean the same (REP-2016: RIHS01, the SHA-256 over a type's description in JSON).

use std::collections::{BTreeMap, BTreeSet};
use std::sync::OnceLock;

use serde::Serialize;
use sha2::{Digest, Sha256};

use super::messages::type_description_interfaces::{
    Field, FieldType, GetTypeDescriptionRequest, GetTypeDescriptionResponse,
    IndividualTypeDescription, TypeDescription, TypeSource,
};

/// Interfaces of ROS's own packages.
const STANDARD: &str = include_str!("interfaces.txt");

/// Ours.
const OURS: [(&str, &str); 9] = {
    macro_rules! ours {
        ($kind:literal, $name:literal) => {
            (
                concat!("tcvae_msgs/", $kind, "/", $name),
                include_str!(concat!("../../msg/tcvae_msgs/", $kind, "/", $name, ".", $kind)),
            )
        };
    }
    [
        ours!("action", "Execute"),
        ours!("msg", "ErrorCode"),
        ours!("msg", "MannerParameter"),
        ours!("msg", "Sample"),
        ours!("msg", "TaskLocation"),
        ours!("srv", "DescribePrimitive"),
        ours!("srv", "LoadModel"),
        ours!("srv", "SampleTrajectory"),
        ours!("srv", "SetManner"),
    ]
};

/// Every type by its name, such as `std_srvs/srv/Trigger_Request`: its own fields.
type Types = BTreeMap<String, Vec<Field>>;

/// The types of `FieldType.msg`, by the names that `.msg` files have for them.
const KINDS: [(&str, u8); 15] = [
    ("int8", 2),
    ("uint8", 3),
    ("int16", 4),
    ("uint16", 5),
    ("int32", 6),
    ("uint32", 7),
    ("int64", 8),
    ("uint64", 9),
    ("float32", 10),
    ("float64", 11),
    ("char", 3),
    ("bool", 15),
    ("byte", 16),
    ("string", STRING),
    ("wstring", 18),
];
const NESTED: u8 = 1;
const STRING: u8 = 17;
/// What a bounded string is more than a string, and what arrays, bounded and unbounded sequences are more than
/// their elements.
const BOUNDED_STRING: u8 = 4;
const ARRAY: u8 = 48;
const BOUNDED_SEQUENCE: u8 = 96;
const SEQUENCE: u8 = 144;

/// The definition of an interface as its file has it, by a name such as `std_srvs/srv/Trigger`.
fn definitions() -> impl Iterator<Item = (&'static str, &'static str)> {
    let standard = STANDARD.split("\n== ").skip(1);
    standard.map(|text| text.split_once('\n').unwrap_or((text, ""))).chain(OURS)
}

fn types() -> &'static Types {
    static TYPES: OnceLock<Types> = OnceLock::new();
    TYPES.get_or_init(|| {
        let mut types = Types::new();
        for (name, definition) in definitions() {
            add(&mut types, name, definition);
        }
        types
    })
}

/// Adds the types that a definition makes.
fn add(types: &mut Types, name: &str, definition: &str) {
    let (package, rest) = name.split_once('/').unwrap_or((name, ""));
    let parts: Vec<Vec<Field>> = parts(definition).map(|part| fields(package, part)).collect();
    let kind = rest.split('/').next().unwrap_or_default();
    match (kind, <[_; 3]>::try_from(parts)) {
        ("action", Ok([goal, result, feedback])) => {
            let goal_id = || nested("goal_id", "unique_identifier_msgs/msg/UUID");
            let part = |field: &str, part: &str| nested(field, &format!("{name}_{part}"));
            let stamp = || nested("stamp", "builtin_interfaces/msg/Time");
            let accepted = plain("accepted", 15);
            let send = [vec![goal_id(), part("goal", "Goal")], vec![accepted, stamp()]];
            add_service(types, &format!("{name}_SendGoal"), send);
            let result_of = [vec![goal_id()], vec![plain("status", 2), part("result", "Result")]];
            add_service(types, &format!("{name}_GetResult"), result_of);
            let message = vec![goal_id(), part("feedback", "Feedback")];
            types.insert(format!("{name}_FeedbackMessage"), message);
            types.insert(format!("{name}_Goal"), goal);
            types.insert(format!("{name}_Result"), result);
            types.insert(format!("{name}_Feedback"), feedback);
        }
        ("srv", Err(parts)) => {
            if let Ok(parts) = <[_; 2]>::try_from(parts) {
                add_service(types, name, parts);
            }
        }
        (_, Err(parts)) => types.extend(parts.into_iter().map(|fields| (name.to_owned(), fields))),
        (_, Ok(_)) => {}
    }
}

fn add_service(types: &mut Types, name: &str, [request, response]: [Vec<Field>; 2]) {
    let part = |part: &str| format!("{name}_{part}");
    let at_most_one = |field: &str, of: &str| {
        let mut field = nested(field, &part(of));
        field.r#type.type_id += BOUNDED_SEQUENCE;
        field.r#type.capacity = 1;
        field
    };
    let info = nested("info", "service_msgs/msg/ServiceEventInfo");
    let event = vec![info, at_most_one("request", "Request"), at_most_one("response", "Response")];
    let service = [("request", "Request"), ("response", "Response"), ("event", "Event")]
        .map(|(field, of)| nested(&format!("{field}_message"), &part(of)));
    types.insert(part("Request"), request);
    types.insert(part("Response"), response);
    types.insert(part("Event"), event);
    types.insert(name.to_owned(), service.into());
}

/// The parts of a definition, which `---` stands between.
fn parts(definition: &str) -> impl Iterator<Item = Vec<&str>> {
    let lines: Vec<&str> =
        definition.lines().map(|line| line.split('#').next().unwrap_or_default().trim()).collect();
    let parts: Vec<Vec<&str>> = lines.split(|line| *line == "---").map(<[_]>::to_vec).collect();
    parts.into_iter()
}

fn fields(package: &str, lines: Vec<&str>) -> Vec<Field> {
    let mut fields: Vec<Field> = lines.iter().filter_map(|line| field(package, line)).collect();
    if fields.is_empty() {
        // A struct has a member in C and C++.
        fields.push(plain("structure_needs_at_least_one_member", 3));
    }
    fields
}

/// A line such as `float64[<=3] position 1.0`; none of a constant.
fn field(package: &str, line: &str) -> Option<Field> {
    let mut words = line.split_whitespace();
    let (kind, name) = (words.next()?, words.next()?);
    let default_value = words.collect::<Vec<_>>().join(" ");
    if name.contains('=') || default_value.starts_with('=') {
        return None;
    }
    let (element, sequence) = match kind.split_once('[') {
        Some((element, count)) => (element, Some(count.trim_end_matches(']'))),
        None => (kind, None),
    };
    let (element, string_capacity) = match element.split_once("<=") {
        Some((string, capacity)) => (string, capacity.parse().ok()?),
        None => (element, 0),
    };
    let mut of = FieldType::default();
    match KINDS.iter().find(|(known, _)| *known == element) {
        Some((_, id)) => of.type_id = *id + if string_capacity > 0 { BOUNDED_STRING } else { 0 },
        None => {
            of.type_id = NESTED;
            let (package, message) = element.split_once('/').unwrap_or((package, element));
            of.nested_type_name = format!("{package}/msg/{message}");
        }
    }
    of.string_capacity = string_capacity;
    match sequence {
        None => {}
        Some("") => of.type_id += SEQUENCE,
        Some(count) => {
            let bounded = count.strip_prefix("<=");
            of.type_id += if bounded.is_some() { BOUNDED_SEQUENCE } else { ARRAY };
            of.capacity = bounded.unwrap_or(count).parse().ok()?;
        }
    }
    Some(Field { name: name.into(), r#type: of, default_value })
}

fn plain(name: &str, type_id: u8) -> Field {
    let r#type = FieldType { type_id, ..FieldType::default() };
    Field { name: name.into(), r#type, default_value: String::new() }
}

fn nested(name: &str, of: &str) -> Field {
    let r#type = FieldType { type_id: NESTED, nested_type_name: of.into(), ..FieldType::default() };
    Field { name: name.into(), r#type, default_value: String::new() }
}

/// What a type is made of, itself and all that it refers to; none where the node does not speak it.
///
/// # Arguments
/// * `name`: such as `std_msgs/msg/Header` or `std_srvs/srv/Trigger_Request`
pub fn description(name: &str) -> Option<TypeDescription> {
    let types = types();
    let individual = |name: &str| {
        let fields = types.get(name)?.clone();
        Some(IndividualTypeDescription { type_name: name.to_owned(), fields })
    };
    let type_description = individual(name)?;
    let mut referenced = BTreeSet::new();
    let mut open = vec![name.to_owned()];
    while let Some(name) = open.pop() {
        for field in types.get(&name)? {
            let of = &field.r#type.nested_type_name;
            if !of.is_empty() && referenced.insert(of.clone()) {
                open.push(of.clone());
            }
        }
    }
    let referenced_type_descriptions: Option<Vec<_>> =
        referenced.iter().map(|name| individual(name)).collect();
    Some(TypeDescription {
        type_description,
        referenced_type_descriptions: referenced_type_descriptions?,
    })
}

/// The definitions that a description comes from: of each type in it that has one of its own.
pub fn sources(description: &TypeDescription) -> Vec<TypeSource> {
    let all = std::iter::once(&description.type_description)
        .chain(&description.referenced_type_descriptions);
    all.filter_map(|of| {
        let (name, text) = definitions().find(|(name, _)| *name == of.type_name)?;
        let encoding = name.split('/').nth(1).unwrap_or_default();
        Some(TypeSource {
            type_name: name.into(),
            encoding: encoding.into(),
            raw_file_contents: text.into(),
        })
    })
    .collect()
}

/// The hash of a type, `RIHS01_` and 64 hexadecimal digits; none where the node does not speak it.
///
/// # Arguments
/// * `name`: as in [`description`]
pub fn hash(name: &str) -> Option<String> {
    // Default values don't count; the order of the members does, and so do the spaces.
    #[derive(Serialize)]
    struct Hashed<'a> {
        type_description: HashedType<'a>,
        referenced_type_descriptions: Vec<HashedType<'a>>,
    }
    #[derive(Serialize)]
    struct HashedType<'a> {
        type_name: &'a str,
        fields: Vec<HashedField<'a>>,
    }
    #[derive(Serialize)]
    struct HashedField<'a> {
        name: &'a str,
        r#type: &'a FieldType,
    }
    fn hashed(of: &IndividualTypeDescription) -> HashedType<'_> {
        let fields = of.fields.iter();
        HashedType {
            type_name: &of.type_name,
            fields: fields.map(|f| HashedField { name: &f.name, r#type: &f.r#type }).collect(),
        }
    }
    let description = description(name)?;
    let text = Hashed {
        type_description: hashed(&description.type_description),
        referenced_type_descriptions: description
            .referenced_type_descriptions
            .iter()
            .map(hashed)
            .collect(),
    };
    let mut json = Vec::new();
    text.serialize(&mut serde_json::Serializer::with_formatter(&mut json, Spaced)).ok()?;
    let digest = Sha256::digest(&json);
    let digits: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
    Some(format!("RIHS01_{digits}"))
}

/// What `~/get_type_description` answers.
pub fn answer(request: &GetTypeDescriptionRequest) -> GetTypeDescriptionResponse {
    let GetTypeDescriptionRequest { type_name, type_hash, include_type_sources } = request;
    let failed = |failure_reason: String| GetTypeDescriptionResponse {
        failure_reason,
        ..GetTypeDescriptionResponse::default()
    };
    let (Some(description), Some(hash)) = (description(type_name), hash(type_name)) else {
        return failed(format!("this node has nothing of the type {type_name}"));
    };
    if !type_hash.is_empty() && *type_hash != hash {
        return failed(format!("{type_name} has the hash {hash} here, not {type_hash}"));
    }
    let type_sources = match include_type_sources {
        true => sources(&description),
        false => Vec::new(),
    };
    GetTypeDescriptionResponse {
        successful: true,
        type_description: description,
        type_sources,
        ..GetTypeDescriptionResponse::default()
    }
}

/// JSON on one line with a space after each comma and colon, as Python writes it.
struct Spaced;

impl serde_json::ser::Formatter for Spaced {
    fn begin_array_value<W: ?Sized + std::io::Write>(
        &mut self,
        writer: &mut W,
        first: bool,
    ) -> std::io::Result<()> {
        if first { Ok(()) } else { writer.write_all(b", ") }
    }

    fn begin_object_key<W: ?Sized + std::io::Write>(
        &mut self,
        writer: &mut W,
        first: bool,
    ) -> std::io::Result<()> {
        self.begin_array_value(writer, first)
    }

    fn begin_object_value<W: ?Sized + std::io::Write>(
        &mut self,
        writer: &mut W,
    ) -> std::io::Result<()> {
        writer.write_all(b": ")
    }
}

/// What an endpoint of this type tells others of it (DDS user data), as ROS 2's middlewares write it.
pub fn user_data(name: &str) -> &'static [u8] {
    static KNOWN: OnceLock<BTreeMap<&'static str, Vec<u8>>> = OnceLock::new();
    let known = KNOWN.get_or_init(|| {
        let told = types().keys().filter_map(|name| {
            Some((name.as_str(), format!("typehash={};", hash(name)?).into_bytes()))
        });
        told.collect()
    });
    known.get(name).map_or(&[], Vec::as_slice)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `tests/golden/type_hashes.py` takes these from the interface packages of Kilted.
    const GOLDEN: &str = include_str!("../../tests/golden/type_hashes.json");

    #[test]
    fn every_type_has_the_hash_that_rosidl_computes() {
        let golden: BTreeMap<String, String> = serde_json::from_str(GOLDEN).unwrap();
        for name in types().keys() {
            let expected = golden.get(name).unwrap_or_else(|| panic!("no golden hash of {name}"));
            assert_eq!(hash(name).as_ref(), Some(expected), "{name}");
        }
        assert!(types().len() > 120, "{}", types().len());
    }

    #[test]
    fn fields_are_read_as_rosidl_reads_them() {
        let of = |line| field("p", line).map(|f| (f.r#type, f.default_value));
        let simple = |type_id, capacity, string_capacity, nested: &str| FieldType {
            type_id,
            capacity,
            string_capacity,
            nested_type_name: nested.into(),
        };
        assert_eq!(of("string<=10[<=3] x"), Some((simple(117, 3, 10, ""), String::new())));
        assert_eq!(of("uint8[16] x"), Some((simple(51, 16, 0, ""), String::new())));
        assert_eq!(of("Point[] x"), Some((simple(145, 0, 0, "p/msg/Point"), String::new())));
        assert_eq!(of("float64 x 1.5"), Some((simple(11, 0, 0, ""), "1.5".into())));
        assert_eq!(of("int32 X=1"), None);
        assert_eq!(of("int32 X = 1"), None);
        assert_eq!(of(""), None);
    }

    #[test]
    fn what_the_node_does_not_speak_has_no_description() {
        assert_eq!(description("std_msgs/msg/Nothing"), None);
        assert_eq!(user_data("std_msgs/msg/Nothing"), b"");
        assert!(user_data("std_msgs/msg/String").starts_with(b"typehash=RIHS01_"));
    }
    #[test]
    fn a_type_is_described_where_its_hash_is_right() {
        let mut request = GetTypeDescriptionRequest {
            type_name: "tcvae_msgs/msg/Sample".into(),
            type_hash: hash("tcvae_msgs/msg/Sample").unwrap(),
            include_type_sources: true,
        };
        let described = answer(&request);
        assert!(described.successful, "{}", described.failure_reason);
        assert!(described.type_sources.iter().any(|s| s.type_name == "tcvae_msgs/msg/Sample"));
        request.type_hash = "RIHS01_0".into();
        let refused = answer(&request);
        assert!(!refused.successful && refused.failure_reason.contains("not RIHS01_0"));
        request.type_name = "no/msg/Such".into();
        assert!(answer(&request).failure_reason.contains("nothing of the type"));
    }
}
