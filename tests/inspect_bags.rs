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
    writer.finish().expect("finished");
}

fn inspected(path: &str, folder: &Path) -> Value {
    let output = tcvae(&["inspect", path, "--json"], folder);
    serde_json::from_slice(&output.stdout).expect("JSON")
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
    assert_eq!(of_file["demonstrations"][0], of_mime["demonstrations"][0]);
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
