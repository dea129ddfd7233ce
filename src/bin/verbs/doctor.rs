//! `tcvae doctor`: why nothing is seen, and what to do about it.

use std::io::IsTerminal;
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use serde_json::json;

use tcvae::ros::doctor::{self, Finding, Verdict};
use tcvae::ros::environment::{DiscoveryRange, Environment};

use super::{ExitStatus, UsageError, print_json, print_line};

#[derive(Debug, Args)]
pub(crate) struct DoctorArgs {
    /// How long to listen for others; they announce themselves about every 3 s
    #[arg(long, value_name = "SECS", default_value_t = 4.0, value_parser = seconds)]
    wait: f64,
    /// Print what was found as JSON
    #[arg(long)]
    pub(crate) json: bool,
}

fn seconds(text: &str) -> Result<f64, String> {
    let parsed: Option<f64> = text.trim().parse().ok();
    parsed
        .filter(|secs| (0.1..=600.0).contains(secs))
        .ok_or_else(|| "a number of seconds from 0.1 to 600 is needed".into())
}

pub(crate) fn run(args: DoctorArgs) -> anyhow::Result<ExitStatus> {
    let variable = |name: &str| std::env::var(name).ok();
    let environment = Environment::read(variable).map_err(|e| UsageError(e.to_string()))?;
    let wait = Duration::from_secs_f64(args.wait);
    let mut told = Told { json: args.json, findings: Vec::new() };

    told.all(doctor::environment(&environment, variable));
    told.all(doctor::interfaces(environment.range));
    told.all(doctor::multicast(environment.range));
    // Before there are participants of our own.
    let here = doctor::domains_here();
    let runtime = tokio::runtime::Runtime::new().context("no threads")?;
    told.all([runtime.block_on(doctor::conversation(&environment))]);
    if environment.range != DiscoveryRange::Off {
        let elsewhere = std::thread::spawn({
            let (own, range) = (environment.domain, environment.range);
            move || match range {
                DiscoveryRange::Subnet => doctor::domains_elsewhere(own, wait),
                _ => Default::default(),
            }
        });
        let others = runtime.block_on(doctor::neighbours(&environment, wait));
        told.all(others.map_err(|e| anyhow::anyhow!(e))?);
        let elsewhere = elsewhere.join().unwrap_or_default();
        told.all(doctor::other_domains(environment.domain, &here, &elsewhere));
    }
    // Endpoints that are dropped say so to others, which takes no more than a moment.
    runtime.shutdown_timeout(Duration::from_secs(1));

    let worst = told.findings.iter().map(|finding| finding.verdict).max();
    let status = match worst {
        Some(Verdict::Bad) => ExitStatus::BelowAsked,
        _ => ExitStatus::Done,
    };
    if args.json {
        print_json(&json!({ "findings": told.findings, "good": status == ExitStatus::Done }));
    } else {
        let count = told.findings.iter().filter(|f| f.verdict == Verdict::Bad).count();
        print_line(&match count {
            0 => "Nothing here keeps programs from seeing each other.".to_owned(),
            1 => "One thing keeps programs from seeing each other; see above.".to_owned(),
            count => format!("{count} things keep programs from seeing each other; see above."),
        });
    }
    Ok(status)
}

/// What was found so far, which a person sees as it comes.
struct Told {
    json: bool,
    findings: Vec<Finding>,
}

impl Told {
    fn all(&mut self, findings: impl IntoIterator<Item = Finding>) {
        for finding in findings {
            if !self.json {
                print_line(&line(&finding));
            }
            self.findings.push(finding);
        }
    }
}

fn line(finding: &Finding) -> String {
    let Finding { check, verdict, fact, next } = finding;
    let (mark, colour) = match verdict {
        Verdict::Good => ("ok  ", "32"),
        Verdict::Doubtful => ("look", "33"),
        Verdict::Bad => ("BAD ", "31"),
    };
    let mark = match std::io::stdout().is_terminal() {
        true => format!("\u{1b}[{colour}m{mark}\u{1b}[0m"),
        false => mark.to_owned(),
    };
    let mut line = format!("{mark} {check:<13}{fact}");
    if !next.is_empty() {
        line += &format!("\n{:18}-> {next}", "");
    }
    line
}
