//! What the tests of the program `tcvae` share.

use std::path::Path;
use std::process::{Command, Output};

/// The program with these arguments, in this folder.
pub(crate) fn command(args: &[&str], folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tcvae"));
    command.args(args).current_dir(folder);
    command
}

/// What the program says to these arguments, in this folder.
pub(crate) fn tcvae(args: &[&str], folder: &Path) -> Output {
    command(args, folder).output().expect("the program starts")
}
