//! Messages as bytes: joint states and numbers, in the two encodings that ROS has used. Only the fields
//! that are asked for are read, and all of these are the first of their messages.

use crate::demonstrations::joint_messages::{JointMessages, MessageTime};

/// How messages are written as bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Encoding {
    /// ROS 2: the OMG's common data representation, with its four bytes ahead.
    Cdr,
    /// ROS 1.
    Ros1,
}

impl Encoding {
    /// By the name that bags give it.
    pub(super) fn named(name: &str) -> Option<Self> {
        match name {
            "cdr" => Some(Self::Cdr),
            "ros1" | "ros1msg" => Some(Self::Ros1),
            _ => None,
        }
    }
}

/// What a topic of a bag tells, as far as it is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Content {
    /// `sensor_msgs/JointState`.
    JointStates,
    /// A number of `std_msgs`.
    Number(Number),
    /// Where something is: `geometry_msgs/PointStamped`, or `PoseStamped` and the like, whose position comes
    /// first.
    Point,
    /// Where something is: `geometry_msgs/TransformStamped`.
    Transform,
    /// That it came is all that is asked for, whatever its type.
    Mark,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Number {
    Bool,
    Int8,
    Int16,
    Int32,
    Int64,
    UInt8,
    UInt16,
    UInt32,
    UInt64,
    Float32,
    Float64,
}

impl Content {
    /// By the type's name of ROS 1 or 2, such as `sensor_msgs/msg/JointState`; none where the type tells
    /// nothing that is asked for.
    pub(super) fn of_type(name: &str) -> Option<Self> {
        let (package, message) = name.split_once('/')?;
        let message = message.strip_prefix("msg/").unwrap_or(message);
        let number = match (package, message) {
            ("sensor_msgs", "JointState") => return Some(Self::JointStates),
            ("geometry_msgs", "PointStamped" | "PoseStamped" | "PoseWithCovarianceStamped") => {
                return Some(Self::Point);
            }
            ("geometry_msgs", "TransformStamped") => return Some(Self::Transform),
            ("std_msgs", "Bool") => Number::Bool,
            ("std_msgs", "Int8") => Number::Int8,
            ("std_msgs", "Int16") => Number::Int16,
            ("std_msgs", "Int32") => Number::Int32,
            ("std_msgs", "Int64") => Number::Int64,
            ("std_msgs", "Byte" | "Char" | "UInt8") => Number::UInt8,
            ("std_msgs", "UInt16") => Number::UInt16,
            ("std_msgs", "UInt32") => Number::UInt32,
            ("std_msgs", "UInt64") => Number::UInt64,
            ("std_msgs", "Float32") => Number::Float32,
            ("std_msgs", "Float64") => Number::Float64,
            _ => return None,
        };
        Some(Self::Number(number))
    }
}

/// Why bytes are no message.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub(super) enum MessageError {
    #[error("it ends at byte {end}, where {needed} more are needed")]
    Short { end: usize, needed: usize },
    #[error("it begins with {first:?}, which is no plain CDR")]
    Encapsulation { first: Vec<u8> },
    #[error("a name in it is no text")]
    Text,
    #[error("it has {names} names and {positions} positions")]
    Lengths { names: usize, positions: usize },
}

/// Gives the messages what one of a topic says.
pub(super) fn take(
    messages: &mut JointMessages<'_>,
    topic: &str,
    content: Content,
    encoding: Encoding,
    log_nanos: i64,
    data: &[u8],
) -> Result<(), MessageError> {
    if content == Content::Mark {
        messages.mark(MessageTime { log_nanos, stamp_nanos: None });
        return Ok(());
    }
    let mut fields = Fields::new(encoding, data)?;
    match content {
        Content::JointStates => {
            let (time, _) = fields.header(log_nanos)?;
            // A text has at least its length.
            let names = fields.count(4)?;
            let mut texts = fields.clone();
            for _ in 0..names {
                fields.text()?;
            }
            let positions = fields.f64s()?;
            // Some publishers leave out what they don't know, but then all of it.
            if positions.len() != 0 && positions.len() != names {
                let positions = positions.len();
                return Err(MessageError::Lengths { names, positions });
            }
            // Read once more rather than kept: a message may hold millions of names.
            let angles = positions.map_while(|position| Some((texts.text().ok()?, position)));
            messages.joint_states(topic, time, angles);
        }
        Content::Number(number) => {
            let value = fields.number(number)?;
            messages.gripper(topic, MessageTime { log_nanos, stamp_nanos: None }, value);
        }
        Content::Point | Content::Transform => {
            let (time, frame) = fields.header(log_nanos)?;
            if content == Content::Transform {
                fields.text()?; // child_frame_id
            }
            let position = [fields.f64()?, fields.f64()?, fields.f64()?];
            messages.point(topic, time, frame, position);
        }
        Content::Mark => {}
    }
    Ok(())
}

/// A message's fields, one after another.
#[derive(Clone)]
struct Fields<'a> {
    /// From the first byte that alignment counts from.
    data: &'a [u8],
    at: usize,
    encoding: Encoding,
    big_endian: bool,
}

impl<'a> Fields<'a> {
    fn new(encoding: Encoding, data: &'a [u8]) -> Result<Self, MessageError> {
        let (data, big_endian) = match encoding {
            Encoding::Ros1 => (data, false),
            Encoding::Cdr => match data.split_first_chunk::<4>() {
                Some(([0, 0, ..], data)) => (data, true),
                Some(([0, 1, ..], data)) => (data, false),
                Some((first, _)) => {
                    return Err(MessageError::Encapsulation { first: first.to_vec() });
                }
                None => return Err(MessageError::Short { end: data.len(), needed: 4 }),
            },
        };
        Ok(Self { data, at: 0, encoding, big_endian })
    }

    /// The next bytes, which as one value begin at a multiple of their number in CDR.
    fn value<const N: usize>(&mut self) -> Result<[u8; N], MessageError> {
        if self.encoding == Encoding::Cdr {
            self.at = self.at.next_multiple_of(N);
        }
        let bytes = self.bytes(N)?;
        let mut value: [u8; N] = bytes.try_into().expect("as many as asked for");
        if self.big_endian {
            value.reverse();
        }
        Ok(value)
    }

    fn bytes(&mut self, count: usize) -> Result<&'a [u8], MessageError> {
        let rest = self.data.get(self.at..).unwrap_or_default();
        let Some(bytes) = rest.get(..count) else {
            let needed = count - rest.len();
            return Err(MessageError::Short { end: self.data.len(), needed });
        };
        self.at += count;
        Ok(bytes)
    }

    /// When a message was sent, and its frame.
    fn header(&mut self, log_nanos: i64) -> Result<(MessageTime, &'a str), MessageError> {
        if self.encoding == Encoding::Ros1 {
            self.u32()?; // seq
        }
        // In ROS 1 seconds have no sign; none of either is beyond 2038 yet.
        let (secs, nanos) = (self.u32()?.cast_signed(), self.u32()?);
        let stamp = i64::from(secs) * 1_000_000_000 + i64::from(nanos);
        let time = MessageTime { log_nanos, stamp_nanos: (stamp != 0).then_some(stamp) };
        Ok((time, self.text()?))
    }

    fn f64(&mut self) -> Result<f64, MessageError> {
        Ok(f64::from_le_bytes(self.value()?))
    }

    fn u32(&mut self) -> Result<u32, MessageError> {
        Ok(u32::from_le_bytes(self.value()?))
    }

    /// How many elements follow, each of `least` bytes or more.
    fn count(&mut self, least: usize) -> Result<usize, MessageError> {
        let count = self.u32()? as usize;
        let left = self.data.len().saturating_sub(self.at);
        match count.checked_mul(least) {
            Some(bytes) if bytes <= left => Ok(count),
            _ => {
                let needed = count.saturating_mul(least) - left;
                Err(MessageError::Short { end: self.data.len(), needed })
            }
        }
    }

    fn text(&mut self) -> Result<&'a str, MessageError> {
        let count = self.count(1)?;
        let bytes = self.bytes(count)?;
        // A CDR string ends with a 0, which counts.
        let bytes = match self.encoding {
            Encoding::Cdr => bytes.strip_suffix(&[0]).unwrap_or(bytes),
            Encoding::Ros1 => bytes,
        };
        std::str::from_utf8(bytes).map_err(|_| MessageError::Text)
    }

    fn f64s(&mut self) -> Result<impl ExactSizeIterator<Item = f64> + use<'a>, MessageError> {
        let count = self.count(8)?;
        if count > 0 && self.encoding == Encoding::Cdr {
            self.at = self.at.next_multiple_of(8);
        }
        let big_endian = self.big_endian;
        let (values, _) = self.bytes(8 * count)?.as_chunks::<8>();
        let value = move |bytes: &[u8; 8]| match big_endian {
            true => f64::from_be_bytes(*bytes),
            false => f64::from_le_bytes(*bytes),
        };
        Ok(values.iter().map(value))
    }

    fn number(&mut self, number: Number) -> Result<f64, MessageError> {
        Ok(match number {
            Number::Bool => f64::from(u8::from(self.value::<1>()?[0] != 0)),
            Number::Int8 => f64::from(i8::from_le_bytes(self.value()?)),
            Number::Int16 => f64::from(i16::from_le_bytes(self.value()?)),
            Number::Int32 => f64::from(i32::from_le_bytes(self.value()?)),
            Number::Int64 => i64::from_le_bytes(self.value()?) as f64,
            Number::UInt8 => f64::from(u8::from_le_bytes(self.value()?)),
            Number::UInt16 => f64::from(u16::from_le_bytes(self.value()?)),
            Number::UInt32 => f64::from(u32::from_le_bytes(self.value()?)),
            Number::UInt64 => u64::from_le_bytes(self.value()?) as f64,
            Number::Float32 => f64::from(f32::from_le_bytes(self.value()?)),
            Number::Float64 => f64::from_le_bytes(self.value()?),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demonstrations::recording::{Channels, GripperChannel, GripperSource};

    fn channels() -> Channels {
        let source = GripperSource { topic: Some("/hand".into()), ..GripperSource::default() };
        let hand = GripperChannel { name: "hand".into(), source };
        Channels {
            joints: vec!["a".into(), "bc".into()],
            grippers: vec![hand],
            ..Channels::default()
        }
    }

    /// `{stamp: 3 s 4 ns, frame_id: "x", name: [a, bc], position: [1.5, -2]}` byte by byte, after the
    /// standard's rules.
    fn cdr(big_endian: bool) -> Vec<u8> {
        let number = |n: u32| if big_endian { n.to_be_bytes() } else { n.to_le_bytes() };
        let real = |x: f64| if big_endian { x.to_be_bytes() } else { x.to_le_bytes() };
        let mut data = vec![0, u8::from(!big_endian), 0, 0];
        data.extend([number(3), number(4), number(2)].concat());
        data.extend(b"x\0\0\0"); // with two bytes of padding
        data.extend([number(2), number(2)].concat());
        data.extend(b"a\0\0\0");
        data.extend(number(3));
        data.extend(b"bc\0\0");
        data.extend(number(2));
        // 40 bytes after the first four, which is a multiple of 8.
        assert_eq!(data.len(), 44);
        data.extend([real(1.5), real(-2.0)].concat());
        data
    }

    fn ros1() -> Vec<u8> {
        let mut data = Vec::new();
        for n in [77_u32, 3, 4, 1] {
            data.extend(n.to_le_bytes());
        }
        data.push(b'x');
        data.extend([2_u32.to_le_bytes(), 1_u32.to_le_bytes()].concat());
        data.push(b'a');
        data.extend(2_u32.to_le_bytes());
        data.extend(b"bc");
        data.extend(2_u32.to_le_bytes());
        data.extend([1.5_f64.to_le_bytes(), (-2.0_f64).to_le_bytes()].concat());
        data
    }

    fn joint_states(encoding: Encoding, data: &[u8]) -> Result<Vec<Vec<f64>>, MessageError> {
        let channels = channels();
        let mut messages = JointMessages::new(&channels);
        take(&mut messages, "/j", Content::JointStates, encoding, 5, data)?;
        Ok(messages.assemble("one").recording.positions)
    }

    #[test]
    fn joint_states_are_read_in_either_byte_order_and_encoding() {
        for (encoding, data) in
            [(Encoding::Cdr, cdr(false)), (Encoding::Cdr, cdr(true)), (Encoding::Ros1, ros1())]
        {
            assert_eq!(joint_states(encoding, &data), Ok(vec![vec![1.5, -2.0]]));
        }
    }

    #[test]
    fn a_message_that_is_cut_off_anywhere_says_where_it_ends() {
        for (encoding, data) in [(Encoding::Cdr, cdr(false)), (Encoding::Ros1, ros1())] {
            for end in 0..data.len() {
                let error = joint_states(encoding, &data[..end]).unwrap_err();
                assert!(matches!(error, MessageError::Short { .. }), "{end}: {error}");
            }
        }
    }

    #[test]
    fn lengths_beyond_the_message_ask_for_no_memory() {
        let mut data = cdr(false);
        data[24..28].copy_from_slice(&u32::MAX.to_le_bytes());
        let error = joint_states(Encoding::Cdr, &data).unwrap_err();
        assert!(matches!(error, MessageError::Short { .. }), "{error}");
        let mut fewer = cdr(false);
        fewer[40] = 1;
        let error = joint_states(Encoding::Cdr, &fewer).unwrap_err();
        assert_eq!(error.to_string(), "it has 2 names and 1 positions");
        let parameters = [0, 3, 0, 0];
        let error = joint_states(Encoding::Cdr, &parameters).unwrap_err();
        assert_eq!(error, MessageError::Encapsulation { first: parameters.to_vec() });
    }

    #[test]
    fn numbers_of_every_type_are_read() {
        let values: [(&str, &[u8], f64); 8] = [
            ("std_msgs/msg/Bool", &[1], 1.0),
            ("std_msgs/Int8", &[0xfe], -2.0),
            ("std_msgs/msg/UInt16", &[0x01, 0x02], 513.0),
            ("std_msgs/msg/Int32", &[0xff; 4], -1.0),
            ("std_msgs/msg/UInt32", &[0xff; 4], 4_294_967_295.0),
            ("std_msgs/msg/Int64", &[0xff; 8], -1.0),
            ("std_msgs/msg/Float32", &[0, 0, 0xc0, 0x3f], 1.5),
            ("std_msgs/Float64", &[0, 0, 0, 0, 0, 0, 0xf8, 0x3f], 1.5),
        ];
        for (name, bytes, expected) in values {
            let Some(Content::Number(number)) = Content::of_type(name) else { panic!("{name}") };
            let data = [&[0, 1, 0, 0], bytes].concat();
            let mut fields = Fields::new(Encoding::Cdr, &data).unwrap();
            assert_eq!(fields.number(number), Ok(expected), "{name}");
        }
        assert_eq!(Content::of_type("std_msgs/msg/String"), None);
        assert_eq!(Content::of_type("my_msgs/msg/JointState"), None);
        assert_eq!(Content::of_type("sensor_msgs/x/JointState"), None);
        assert_eq!(Content::of_type(""), None);
    }

    #[test]
    fn where_something_is_is_read_from_points_poses_and_transforms_of_both_ros() {
        // What rosbags 0.11.9 writes of (0.5, -0.25, 1.5) in "base" at 3.0000005 s, of a bowl.
        let header = "03000000f4010000";
        let point = "000000000000e03f000000000000d0bf000000000000f83f";
        let turn = "000000000000000000000000000000000000000000000000000000000000f03f";
        let cdr = format!("00010000{header}0500000062617365");
        let ros1 = format!("07000000{header}0400000062617365");
        for (encoding, name, hex) in [
            (Encoding::Cdr, "PointStamped", format!("{cdr}00{}{point}", "00".repeat(7))),
            (Encoding::Cdr, "PoseStamped", format!("{cdr}00{}{point}{turn}", "00".repeat(7))),
            (
                Encoding::Cdr,
                "TransformStamped",
                format!("{cdr}0000000005000000626f776c00000000{point}{turn}"),
            ),
            (Encoding::Ros1, "PointStamped", format!("{ros1}{point}")),
            (Encoding::Ros1, "PoseStamped", format!("{ros1}{point}{turn}")),
            (Encoding::Ros1, "TransformStamped", format!("{ros1}04000000626f776c{point}{turn}")),
        ] {
            let data: Vec<u8> = (0..hex.len())
                .step_by(2)
                .map(|i| u8::from_str_radix(&hex[i..i + 2], 16).unwrap())
                .collect();
            let channels = channels();
            let mut messages = JointMessages::new(&channels);
            let content = Content::of_type(&format!("geometry_msgs/msg/{name}")).unwrap();
            take(&mut messages, "/bowl", content, encoding, 5, &data).unwrap();
            let points = messages.assemble("r").recording.points;
            assert_eq!((points[0].topic.as_str(), points[0].frame.as_str()), ("/bowl", "base"));
            assert_eq!(points[0].positions_m, [[0.5, -0.25, 1.5]], "{name}");
            for end in 0..40 {
                let mut messages = JointMessages::new(&channels);
                let cut = take(&mut messages, "/bowl", content, encoding, 5, &data[..end]);
                assert!(cut.is_err(), "{name} of {end} bytes");
            }
        }
    }
}
