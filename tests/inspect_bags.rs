//! Pours in bags are found as those in the layout of MIME are.
#![cfg(all(feature = "bag", feature = "train"))]

mod support;

use std::borrow::Cow;
use std::fs::{self, File};
use std::path::Path;
use std::sync::Arc;

use mcap::{Channel, Message, Schema};
use serde_json::Value;
use support::tcvae;
use tcvae::demonstrations::recording::{JointRecording, RobotConfig};
use tcvae::mime;

/// A joint state in CDR, as a publisher on a PC writes it.
fn joint_state(nanos: u64, names: &[String], positions: &[f64]) -> Vec<u8> {
    let mut data = vec![0, 1, 0, 0];
    fn number(data: &mut Vec<u8>, number: u32) {
        while !data.len().is_multiple_of(4) {
            data.push(0);
        }
        data.extend(number.to_le_bytes());
    }
    fn text(data: &mut Vec<u8>, text: &str) {
        number(data, text.len() as u32 + 1);
        data.extend(text.bytes().chain([0]));
    }
    number(&mut data, (nanos / 1_000_000_000) as u32);
    number(&mut data, (nanos % 1_000_000_000) as u32);
    text(&mut data, "base");
    number(&mut data, names.len() as u32);
    names.iter().for_each(|name| text(&mut data, name));
    number(&mut data, positions.len() as u32);
    // Alignment counts from after the first four bytes.
    while data.len() % 8 != 4 {
        data.push(0);
    }
    positions.iter().for_each(|position| data.extend(position.to_le_bytes()));
    number(&mut data, 0);
    number(&mut data, 0);
    data
}

/// A recording as a bag in which Baxter's fingers are joints.
fn write(recording: &JointRecording, path: &Path) {
    write_with(recording, &[], path);
}

/// Such a bag with other messages: topic, type, time and data of each.
fn write_with(recording: &JointRecording, others: &[(&str, &str, f64, Vec<u8>)], path: &Path) {
    let file = File::create(path).expect("a file");
    let mut writer = mcap::Writer::new(file).expect("a bag");
    let schema = Schema {
        id: 1,
        name: "sensor_msgs/msg/JointState".into(),
        encoding: "ros2msg".into(),
        data: Cow::Borrowed(b""),
    };
    let channel = Arc::new(Channel {
        id: 0,
        topic: "/robot/joint_states".into(),
        schema: Some(Arc::new(schema)),
        message_encoding: "cdr".into(),
        metadata: Default::default(),
    });
    let mut names = recording.joint_names.clone();
    let fingers =
        recording.grippers.iter().map(|g| format!("{}_gripper_l_finger_joint", &g.name[..1]));
    names.extend(fingers);
    for (i, (time, joints)) in recording.times_secs.iter().zip(&recording.positions).enumerate() {
        let nanos = 1_700_000_000_000_000_000 + (time * 1e9).round() as u64;
        let mut positions = joints.clone();
        positions.extend(recording.grippers.iter().map(|g| g.percent_open[i] * 0.01 * 0.0208));
        let message = Message {
            channel: channel.clone(),
            sequence: i as u32,
            log_time: nanos + 300_000,
            publish_time: nanos,
            data: Cow::Owned(joint_state(nanos, &names, &positions)),
        };
        writer.write(&message).expect("written");
    }
    for (topic, type_name, time, data) in others {
        let nanos = 1_700_000_000_000_000_000 + (time * 1e9).round() as u64;
        let schema = writer.add_schema(type_name, "ros2msg", b"").expect("a schema");
        let channel = writer.add_channel(schema, topic, "cdr", &Default::default());
        let header = mcap::records::MessageHeader {
            channel_id: channel.expect("a channel"),
            sequence: 0,
            log_time: nanos,
            publish_time: nanos,
        };
        writer.write_to_known_channel(&header, data).expect("written");
    }
    writer.finish().expect("finished");
}

fn inspected(path: &str, folder: &Path) -> Value {
    let output = tcvae(&["inspect", path, "--json"], folder);
    serde_json::from_slice(&output.stdout).expect("JSON")
}

/// A point in CDR, without a stamp.
fn point(frame: &str, [x, y]: [f64; 2]) -> Vec<u8> {
    let mut data = vec![0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
    data.extend((frame.len() as u32 + 1).to_le_bytes());
    data.extend(frame.bytes().chain([0]));
    while data.len() % 8 != 4 {
        data.push(0);
    }
    [x, y, 0.0].iter().for_each(|value| data.extend(value.to_le_bytes()));
    data
}

#[test]
fn a_topic_says_where_the_pour_was_to_be_and_a_marker_where_a_demonstration_ends() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    let simulate = ["simulate", "pouring", "--seed", "6", "--count", "14", "-o", "mime"];
    assert_eq!(tcvae(&simulate, path).status.code(), Some(0));
    let mime = inspected("mime", path);
    let demonstrations = mime["demonstrations"].as_array().expect("a list");
    let channels = RobotConfig::default().channels();
    let read = |demonstration: &Value| {
        let id = demonstration["id"].as_str().expect("a name");
        mime::read(&path.join("mime").join(id), &channels).expect("readable").recording
    };
    let number = |v: &Value| v.as_f64().expect("a number");
    let place = |d: &Value| [0, 1].map(|i| number(&d["task"]["pour_location"][i]));
    let accepted = |arm: &str| {
        demonstrations.iter().find(|d| d["accepted"] == true && d["arm"] == arm).expect("one")
    };
    let task = |more: &str| {
        let base = format!("based_on = \"{}/config/tasks/pour.toml\"", env!("CARGO_MANIFEST_DIR"));
        fs::write(path.join("task.toml"), format!("{base}\n{more}")).expect("written");
    };
    let locations = "[[locations]]\nname = \"pour_location\"\nat = \"action\"\ntopic = \"/bowl\"\n\
                     [[locations]]\nname = \"source_cup\"\nat = \"start\"\n";
    task(locations);
    let inspect = |bag: &str| {
        let output = tcvae(&["inspect", bag, "--task", "task.toml", "--json"], path);
        let answer: Value = serde_json::from_slice(&output.stdout).expect("JSON");
        answer["demonstrations"].clone()
    };
    let type_name = "geometry_msgs/msg/PointStamped";
    for (arm, sign) in [("left", 1.0), ("right", -1.0)] {
        let demonstration = accepted(arm);
        // 2 cm beside where the motion shows it, in the base frame, where the right arm is not mirrored.
        let [x, y] = place(demonstration);
        let told = |by: f64| ("/bowl", type_name, 0.5, point("base", [x + by, sign * y]));
        let later = ("/bowl", type_name, 9e3, point("base", [0.0, 0.0]));
        write_with(&read(demonstration), &[told(0.02), later], &path.join("a.mcap"));
        let found = &inspect("a.mcap")[0];
        assert_eq!(found["accepted"], true, "{found}");
        let off = [place(found)[0] - x, place(found)[1] - y];
        assert!((off[0] - 0.02).abs() < 1e-6 && off[1].abs() < 1e-6, "{off:?}");

        write_with(&read(demonstration), &[told(0.08)], &path.join("b.mcap"));
        let found = &inspect("b.mcap")[0];
        assert_eq!(found["reason"], "out_of_region");
        let said = "the motion is 0.080 m from pour_location on /bowl, limit 0.05 m";
        assert_eq!(found["detail"], said);
    }
    let demonstration = accepted("left");
    let odd = ("/bowl", type_name, 0.5, point("camera", [0.6, 0.2]));
    write_with(&read(demonstration), &[odd], &path.join("c.mcap"));
    assert_eq!(
        inspect("c.mcap")[0]["detail"],
        "/bowl is in the frame \"camera\"; \"base\" is needed"
    );
    write(&read(demonstration), &path.join("d.mcap"));
    let said = "pour_location is on the topic /bowl, which has no point or pose in the recording";
    assert_eq!(inspect("d.mcap")[0]["detail"], said);

    // Two recordings in one, and a mark of any type between them.
    task("[recording]\ncut_at = { marker = \"/next\" }\n");
    let (first, second) = (accepted("left"), accepted("right"));
    let (mut both, more) = (read(first), read(second));
    let end = both.times_secs[both.times_secs.len() - 1];
    // The arms come to where the next begins.
    let frames = 200;
    let (a, b) = (both.positions[both.positions.len() - 1].clone(), more.positions[0].clone());
    for i in 1..frames {
        let share = f64::from(i) / f64::from(frames);
        both.positions.push(a.iter().zip(&b).map(|(a, b)| a + share * (b - a)).collect());
        both.times_secs.push(end + 0.01 * f64::from(i));
        both.grippers.iter_mut().for_each(|g| g.percent_open.push(100.0));
    }
    let start = end + 0.01 * f64::from(frames);
    both.times_secs.extend(more.times_secs.iter().map(|t| t + start));
    both.positions.extend(more.positions);
    for (gripper, more) in both.grippers.iter_mut().zip(more.grippers) {
        gripper.percent_open.extend(more.percent_open);
    }
    let mark = ("/next", "my_msgs/msg/Mark", start, vec![9, 9]);
    write_with(&both, &[mark], &path.join("e.mcap"));
    let found = inspect("e.mcap");
    let arms: Vec<_> = found.as_array().expect("a list").iter().map(|d| &d["arm"]).collect();
    assert_eq!(arms, ["left", "right"], "{found}");
}

#[test]
fn a_bag_is_left_out_or_accepted_as_the_same_recording_in_the_layout_of_mime() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    let simulate = ["simulate", "pouring", "--seed", "6", "--count", "14", "-o", "mime"];
    assert_eq!(tcvae(&simulate, path).status.code(), Some(0));
    fs::create_dir(path.join("bags")).expect("a folder");
    let channels = RobotConfig::default().channels();
    let demonstrations = mime::find(&path.join("mime")).expect("demonstrations");
    let mut written = 0;
    for demonstration in demonstrations {
        let Ok(read) = mime::read(&demonstration, &channels) else { continue };
        let id = demonstration.file_name().expect("a name").to_str().expect("text");
        write(&read.recording, &path.join(format!("bags/{id}.mcap")));
        written += 1;
    }
    assert!(written >= 12, "{written}");

    let (mime, bags) = (inspected("mime", path), inspected("bags", path));
    let of_mime = mime["demonstrations"].as_array().expect("a list");
    let of_bags = bags["demonstrations"].as_array().expect("a list");
    assert_eq!(of_bags.len(), written);
    let mut accepted = 0;
    for bag in of_bags {
        let id = bag["id"].as_str().expect("a name").trim_end_matches(".mcap");
        let same = of_mime.iter().find(|m| m["id"] == id).expect("the same recording");
        for field in ["accepted", "reason", "arm"] {
            assert_eq!(bag[field], same[field], "{id}: {field}");
        }
        if bag["accepted"] == true {
            accepted += 1;
            for location in ["pour_location", "source_cup"] {
                for i in 0..2 {
                    let value = |v: &Value| v["task"][location][i].as_f64().expect("a number");
                    assert!((value(bag) - value(same)).abs() < 1e-6, "{id}: {bag} {same}");
                }
            }
        }
    }
    assert!(accepted >= 8, "{accepted}");
}

#[test]
fn a_bag_with_several_pours_is_cut_between_them() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    let simulate = ["simulate", "pouring", "--seed", "8", "--count", "10", "-o", "mime"];
    assert_eq!(tcvae(&simulate, path).status.code(), Some(0));
    let of_mime = inspected("mime", path);
    let accepted = of_mime["demonstrations"].as_array().expect("a list");
    // One arm's, so that the other's hand need not jump from one to the next.
    let accepted: Vec<_> =
        accepted.iter().filter(|d| d["accepted"] == true && d["arm"] == "left").collect();
    assert!(accepted.len() >= 2);

    let channels = RobotConfig::default().channels();
    let mut together: Option<JointRecording> = None;
    for one in &accepted {
        let id = one["id"].as_str().expect("a name");
        let demonstrations = mime::find(&path.join("mime")).expect("demonstrations");
        let found = demonstrations.iter().find(|d| d.ends_with(id)).expect("the same");
        let next = mime::read(found, &channels).expect("readable").recording;
        match &mut together {
            None => together = Some(next),
            Some(all) => append(all, &next),
        }
    }
    write(&together.expect("pours"), &path.join("session.mcap"));
    let of_bag = inspected("session.mcap", path);
    let found = of_bag["demonstrations"].as_array().expect("a list");
    assert_eq!(found.len(), accepted.len(), "{of_bag}");
    for (number, (found, expected)) in found.iter().zip(&accepted).enumerate() {
        assert_eq!(found["id"], format!("session.mcap#{}", number + 1));
        assert_eq!(found["accepted"], true, "{found}");
        for location in ["pour_location", "source_cup"] {
            for i in 0..2 {
                let value = |v: &Value| v["task"][location][i].as_f64().expect("a number");
                assert!((value(found) - value(expected)).abs() < 1e-6, "{found} {expected}");
            }
        }
    }
    let output = tcvae(&["inspect", "session.mcap", "--json", "--only", "session.mcap#2"], path);
    let only: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(only["summary"]["accepted"], 1);
}

/// Lets a recording go on with another, after two seconds in which the joints move over in proportion.
fn append(all: &mut JointRecording, next: &JointRecording) {
    let last = all.positions.last().expect("a frame").clone();
    let start = all.times_secs.last().expect("a frame") + 0.01;
    for i in 0..200 {
        let share = f64::from(i) / 200.0;
        all.times_secs.push(start + 0.01 * f64::from(i));
        let between = last.iter().zip(&next.positions[0]).map(|(a, b)| a + share * (b - a));
        all.positions.push(between.collect());
        all.grippers
            .iter_mut()
            .for_each(|g| g.percent_open.push(*g.percent_open.last().expect("one")));
    }
    all.times_secs.extend(next.times_secs.iter().map(|t| start + 2.0 + t));
    all.positions.extend(next.positions.iter().cloned());
    for (gripper, next) in all.grippers.iter_mut().zip(&next.grippers) {
        gripper.percent_open.extend(&next.percent_open);
    }
}

/// Six simulated demonstrations in `mime/`, and what inspect finds in them.
fn simulated(path: &Path) -> Value {
    let simulate = ["simulate", "pouring", "--seed", "6", "--count", "6", "-o", "mime"];
    assert_eq!(tcvae(&simulate, path).status.code(), Some(0));
    inspected("mime", path)
}

/// The same demonstrations, accepted or left out for the same reasons, with the same tasks.
fn assert_same(found: &Value, expected: &Value, id: impl Fn(&str) -> String) {
    let list = |value: &Value| value["demonstrations"].as_array().expect("a list").clone();
    let (found, expected) = (list(found), list(expected));
    assert_eq!(found.len(), expected.len());
    for expected in &expected {
        let name = id(expected["id"].as_str().expect("a name"));
        let same = found.iter().find(|d| d["id"] == name.as_str());
        let same = same.unwrap_or_else(|| panic!("{name} in {found:?}"));
        for field in ["accepted", "reason", "arm"] {
            assert_eq!(same[field], expected[field], "{name}: {field}");
        }
        for location in ["pour_location", "source_cup"] {
            for i in 0..2 {
                let value = |v: &Value| v["task"][location][i].as_f64().unwrap_or(0.0);
                assert!((value(same) - value(expected)).abs() < 1e-6, "{name}");
            }
        }
    }
}

#[test]
fn a_table_is_left_out_or_accepted_as_the_same_recording_in_the_layout_of_mime() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    let of_mime = simulated(path);
    let channels = RobotConfig::default().channels();
    fs::create_dir(path.join("tables")).expect("a folder");
    for (number, demonstration) in
        mime::find(&path.join("mime")).expect("demonstrations").iter().enumerate()
    {
        let recording = mime::read(demonstration, &channels).expect("readable").recording;
        // Baxter's fingers as joints, or per cent.
        let in_per_cent = number % 2 == 0;
        let mut text = "time_ns".to_owned();
        recording.joint_names.iter().for_each(|name| text += &format!(",{name}"));
        for gripper in &recording.grippers {
            let finger = format!("{}_gripper_l_finger_joint", &gripper.name[..1]);
            text += &format!(",{}", if in_per_cent { &gripper.name } else { &finger });
        }
        for (i, (time, joints)) in recording.times_secs.iter().zip(&recording.positions).enumerate()
        {
            text += &format!("\n{}", 1_700_000_000_000_000_000 + (time * 1e9).round() as i64);
            joints.iter().for_each(|angle| text += &format!(",{angle}"));
            for gripper in &recording.grippers {
                let open = gripper.percent_open[i];
                text += &format!(",{}", if in_per_cent { open } else { open * 0.01 * 0.0208 });
            }
        }
        let id = demonstration.file_name().expect("a name").to_str().expect("text");
        fs::write(path.join(format!("tables/{id}.csv")), text).expect("written");
    }
    let of_tables = inspected("tables", path);
    assert_same(&of_tables, &of_mime, |id| format!("{id}.csv"));
    assert!(of_tables["summary"]["accepted"].as_u64() > Some(2), "{of_tables}");
    assert_eq!(of_tables["summary"]["synthetic"], false);
}

/// Files as an archive; those below a folder with their paths in it.
fn zip(files: &[(String, Vec<u8>)]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut archive = rawzip::ZipArchiveWriter::new(&mut bytes);
    for (name, content) in files {
        let deflate = rawzip::CompressionMethod::DEFLATE;
        let (mut entry, config) = archive
            .new_file(rawzip::path::EntryPath::verbatim(name.as_bytes()))
            .compression_method(deflate)
            .start()
            .expect("a file");
        let encoder = flate2::write::DeflateEncoder::new(&mut entry, Default::default());
        let mut writer = config.wrap(encoder);
        std::io::Write::write_all(&mut writer, content).expect("written");
        let (encoder, descriptor) = writer.finish().expect("whole");
        encoder.finish().expect("whole");
        entry.finish(descriptor).expect("whole");
    }
    archive.finish().expect("whole");
    bytes
}

fn files_below(folder: &Path, inside: &str, found: &mut Vec<(String, Vec<u8>)>) {
    for entry in fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        let name = format!("{inside}{}", path.file_name().expect("a name").to_string_lossy());
        if path.is_dir() {
            files_below(&path, &format!("{name}/"), found);
        } else {
            found.push((name, fs::read(&path).expect("a file")));
        }
    }
}

#[test]
fn an_archive_is_read_as_the_folder_that_was_packed() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    let of_mime = simulated(path);
    let mut files = Vec::new();
    files_below(&path.join("mime"), "task/", &mut files);
    files.push(("task/video.mp4".into(), vec![7; 1000]));
    fs::write(path.join("mime.zip"), zip(&files)).expect("written");
    let of_archive = inspected("mime.zip", path);
    assert_same(&of_archive, &of_mime, str::to_owned);
    assert_eq!(of_archive["summary"]["synthetic"], true, "truth.json is in it");
    let digests = |value: &Value| value["summary"]["accepted"].clone();
    assert_eq!(digests(&of_archive), digests(&of_mime));

    // A file of one stands for it, and so does an archive of its files alone; bags may be in one too.
    let first = of_mime["demonstrations"][0]["id"].as_str().expect("a name");
    let of_file = inspected(&format!("mime/{first}/joint_angles.txt"), path);
    // Without the others it has no neighbour.
    let mut alone = of_mime["demonstrations"][0].clone();
    alone["nearest"] = Value::Null;
    assert_eq!(of_file["demonstrations"][0], alone);
    let mut one = Vec::new();
    files_below(&path.join("mime").join(first), "", &mut one);
    let bags = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/bags");
    one.push(("more/zstd.mcap".into(), fs::read(bags.join("zstd.mcap")).expect("a bag")));
    for part in 0..3 {
        let name = format!("sqlite_split/sqlite_split_{part}.db3");
        one.push((name.clone(), fs::read(bags.join(&name)).expect("a bag")));
    }
    one.push(("../evil.csv".into(), b"time,a".to_vec()));
    fs::create_dir(path.join("archives")).expect("a folder");
    fs::write(path.join("archives/one.ZIP"), zip(&one)).expect("written");
    fs::write(path.join("archives/none.zip"), "PK").expect("written");
    let found = inspected("archives", path);
    let list = found["demonstrations"].as_array().expect("a list");
    let ids: Vec<_> = list.iter().map(|d| d["id"].as_str().expect("a name")).collect();
    assert_eq!(ids, ["none.zip", "zstd.mcap", "sqlite_split", "one", "evil.csv"], "{found}");
    assert_eq!(list[3]["accepted"], of_mime["demonstrations"][0]["accepted"]);
    assert_eq!(list[4]["detail"], "its path leads out of the archive");
    let told = list[0]["detail"].as_str().expect("text");
    assert!(told.starts_with("archives/none.zip: no zip archive can be read"), "{told}");
}

#[cfg(unix)]
#[test]
fn what_links_lead_to_again_is_one_recording() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    fs::create_dir(path.join("bags")).expect("a folder");
    fs::write(path.join("bags/empty.mcap"), "").expect("a file");
    std::os::unix::fs::symlink(".", path.join("bags/again")).expect("a link");
    let output = tcvae(&["inspect", "bags", "bags/empty.mcap", "--json"], path);
    let found: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(found["summary"]["recordings"], 1, "{found}");
    assert_eq!(found["demonstrations"][0]["id"], "empty.mcap");
    assert_eq!(found["demonstrations"][0]["reason"], "unreadable");
}

#[test]
fn a_gripper_that_is_open_where_it_is_closed_is_wrong_usage() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    fs::write(path.join("empty.mcap"), "").expect("a file");
    let shipped = include_str!("../config/robots/baxter.toml");
    for open in ["0.0", "nan"] {
        let robot = shipped.replacen("open = 0.0208", &format!("open = {open}"), 1);
        assert_ne!(robot, shipped);
        fs::write(path.join("robot.toml"), robot).expect("a file");
        let output = tcvae(&["inspect", "empty.mcap", "--robot", "robot.toml"], path);
        assert_eq!(output.status.code(), Some(2), "{output:?}");
        let told = String::from_utf8(output.stderr).expect("text");
        assert!(told.contains("gripper_source is closed at 0 and open at"), "{told}");
    }
}
