#![no_main]

use std::borrow::Cow;
use std::io::Cursor;
use std::sync::Arc;

/// Types, and the encodings that name them so.
const KINDS: [(&str, &str, &str); 5] = [
    ("/j", "sensor_msgs/msg/JointState", "cdr"),
    ("/j", "sensor_msgs/JointState", "ros1"),
    ("/g", "std_msgs/msg/Float64", "cdr"),
    ("/g", "std_msgs/Int16", "ros1"),
    ("/g", "std_msgs/msg/Bool", "cdr"),
];

// The first byte says of which kind the rest is; the kinds stand side by side in a bag without chunks.
libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    let Some((kind, rest)) = data.split_first() else { return };
    let (topic, type_name, encoding) = KINDS[usize::from(*kind) % KINDS.len()];
    let mut bytes = Cursor::new(Vec::new());
    let options = mcap::WriteOptions::new().use_chunks(false).compression(None);
    let mut writer = options.create(&mut bytes).expect("a bag");
    let schema = mcap::Schema {
        id: 1,
        name: type_name.into(),
        encoding: String::new(),
        data: Cow::Borrowed(b""),
    };
    let channel = Arc::new(mcap::Channel {
        id: 0,
        topic: topic.into(),
        schema: Some(Arc::new(schema)),
        message_encoding: encoding.into(),
        metadata: Default::default(),
    });
    for (i, part) in rest.split_inclusive(|byte| *byte == 0xfe).enumerate() {
        let message = mcap::Message {
            channel: channel.clone(),
            sequence: 0,
            log_time: i as u64,
            publish_time: 0,
            data: Cow::Borrowed(part),
        };
        writer.write(&message).expect("written");
    }
    writer.finish().expect("finished");
    drop(writer);
    tcvae_fuzz::bag("one.mcap", bytes.get_ref());
});
