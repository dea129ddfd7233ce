//! The classical primitives as one type, for what stores, measures and serves whichever of them
//! there is.

use rand::Rng;
use serde::{Deserialize, Serialize};

use super::{DmpConfig, DmpPrimitive, PrimitiveError, ProMp, ProMpConfig, TpGmm, TpGmmConfig};
use crate::parameters::{MannerParameters, MannerSpace, TaskParameters, TaskSpace};
use crate::primitive::{Demonstration, Generated, MannerConditioned, MovementPrimitive};

/// What every classical primitive has of manner parameters.
static NO_MANNER: MannerSpace = MannerSpace::none();

/// A primitive with the settings that it was fitted with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fitted<C, P> {
    /// The settings.
    pub settings: C,
    /// What was learned.
    pub parts: P,
}

/// Which classical primitive to fit, and its settings.
#[derive(Debug, Clone, PartialEq)]
pub enum ClassicalConfig {
    /// A task-parameterised Gaussian mixture.
    TpGmm(TpGmmConfig),
    /// A probabilistic movement primitive.
    ProMp(ProMpConfig),
    /// A dynamic movement primitive.
    Dmp(DmpConfig),
}

impl ClassicalConfig {
    /// Fits the primitive to demonstrations. Give it those that were recorded: copies of them are
    /// for a network, which needs thousands.
    ///
    /// # Errors
    /// As [`TpGmm::fit`], [`ProMp::fit`] and [`DmpPrimitive::fit`].
    pub fn fit(
        self,
        space: &TaskSpace,
        demonstrations: &[Demonstration],
    ) -> Result<Classical, PrimitiveError> {
        Ok(match self {
            Self::TpGmm(settings) => {
                let parts = TpGmm::fit(&settings, space, demonstrations)?;
                Classical::TpGmm(Fitted { settings, parts })
            }
            Self::ProMp(settings) => {
                let parts = ProMp::fit(&settings, space, demonstrations)?;
                Classical::ProMp(Fitted { settings, parts })
            }
            Self::Dmp(settings) => {
                let parts = DmpPrimitive::fit(&settings, space, demonstrations)?;
                Classical::Dmp(Fitted { settings, parts })
            }
        })
    }
}

/// A fitted classical primitive. Its manner space is empty: it has one motion for each task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Classical {
    /// A task-parameterised Gaussian mixture.
    TpGmm(Fitted<TpGmmConfig, TpGmm>),
    /// A probabilistic movement primitive.
    #[serde(rename = "promp")]
    ProMp(Fitted<ProMpConfig, ProMp>),
    /// A dynamic movement primitive.
    Dmp(Fitted<DmpConfig, DmpPrimitive>),
}

impl Classical {
    /// Its name, as people write it.
    pub fn name(&self) -> &'static str {
        match self {
            Self::TpGmm(_) => "TP-GMM",
            Self::ProMp(_) => "ProMP",
            Self::Dmp(_) => "DMP",
        }
    }

    fn inner(&self) -> &dyn MovementPrimitive {
        match self {
            Self::TpGmm(fitted) => &fitted.parts,
            Self::ProMp(fitted) => &fitted.parts,
            Self::Dmp(fitted) => &fitted.parts,
        }
    }
}

impl MovementPrimitive for Classical {
    fn task_space(&self) -> &TaskSpace {
        self.inner().task_space()
    }

    fn steps(&self) -> usize {
        self.inner().steps()
    }

    fn state_dim(&self) -> usize {
        self.inner().state_dim()
    }

    fn generate(&self, w: &TaskParameters) -> Generated {
        self.inner().generate(w)
    }
}

impl MannerConditioned for Classical {
    fn manner_space(&self) -> &MannerSpace {
        &NO_MANNER
    }

    fn decode(&self, w: &TaskParameters, _: &MannerParameters) -> Generated {
        self.generate(w)
    }

    fn sample_manner(&self, _: &mut dyn Rng) -> MannerParameters {
        MannerParameters::mean(&NO_MANNER)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use serde_json::{Value, json};

    use super::*;
    use crate::primitives::tests::{demonstrations, space, task};

    /// Each of the primitives, fitted to a few demonstrations of two locations.
    pub(crate) fn all() -> [Classical; 3] {
        let steps = 20;
        let configs = [
            ClassicalConfig::TpGmm(TpGmmConfig { steps, components: 4, ..Default::default() }),
            ClassicalConfig::ProMp(ProMpConfig { steps, basis_functions: 5, ..Default::default() }),
            ClassicalConfig::Dmp(DmpConfig { steps, basis_functions: 5, ..Default::default() }),
        ];
        configs.map(|config| config.fit(&space(2), &demonstrations(2, 12)).unwrap())
    }

    #[test]
    fn what_is_stored_is_what_is_read_and_says_what_it_is() {
        for (primitive, name) in all().into_iter().zip(["tp-gmm", "promp", "dmp"]) {
            let text = serde_json::to_string(&primitive).unwrap();
            assert!(text.starts_with(&format!("{{\"{name}\":{{\"settings\":{{\"steps\":20,")));
            let read: Classical = serde_json::from_str(&text).unwrap();
            assert_eq!(read, primitive);
            let w = task(&[0.3, 0.2, -0.4, 0.1]);
            assert_eq!(read.generate(&w), primitive.generate(&w));
        }
    }

    /// Replaces every leaf of a document, one after the other.
    fn each_replaced(value: &Value, by: &Value, visit: &mut impl FnMut(&str, Value)) {
        let mut pointers = Vec::new();
        let mut open = vec![(String::new(), value)];
        while let Some((pointer, value)) = open.pop() {
            match value {
                Value::Object(map) => {
                    open.extend(map.iter().map(|(key, v)| (format!("{pointer}/{key}"), v)));
                }
                Value::Array(list) => {
                    open.extend(
                        list.iter().enumerate().map(|(i, v)| (format!("{pointer}/{i}"), v)),
                    );
                }
                _ => pointers.push(pointer),
            }
        }
        for pointer in pointers {
            let mut crafted = value.clone();
            *crafted.pointer_mut(&pointer).unwrap() = by.clone();
            visit(&pointer, crafted);
        }
    }

    #[test]
    fn no_crafted_number_makes_one_panic() {
        let tasks = [0.0, 1e308, -1e308].map(|v| task(&[v, -v, 0.5 * v, v]));
        for primitive in all() {
            let stored = serde_json::to_value(&primitive).unwrap();
            let (mut refused, mut read) = (0, 0);
            for by in [
                json!(1e308),
                json!(-1e9),
                json!(1e-308),
                json!(0),
                json!(u64::MAX),
                json!(i64::MAX),
                json!("NaN"),
                json!([]),
                json!(null),
            ] {
                each_replaced(&stored, &by, &mut |pointer, crafted| {
                    // What was set does not matter any more.
                    let settings = pointer.contains("/settings/");
                    match serde_json::from_value::<Classical>(crafted) {
                        Err(error) => {
                            refused += usize::from(!settings);
                            assert!(!error.to_string().is_empty());
                        }
                        Ok(primitive) => {
                            read += usize::from(!settings);
                            tasks.iter().for_each(|w| drop(primitive.generate(w)));
                        }
                    }
                });
            }
            assert!(refused > 100 && read > 100, "{}: {refused} {read}", primitive.name());
        }
    }

    #[test]
    fn parts_of_other_sizes_are_refused_with_both() {
        let refused = |primitive: &Classical, pointer: &str, by: Value| {
            let mut crafted = serde_json::to_value(primitive).unwrap();
            *crafted.pointer_mut(pointer).unwrap() = by;
            serde_json::from_value::<Classical>(crafted).unwrap_err().to_string()
        };
        let [tp_gmm, promp, dmp] = all();
        for (primitive, pointer, by, reason) in [
            (&tp_gmm, "/tp-gmm/parts/mixture/weights", json!([1.0]), "not 1 Gaussians in each"),
            (&tp_gmm, "/tp-gmm/parts/steps", json!(20_001), "20001 steps of 3 values; 2 to 20000"),
            (&tp_gmm, "/tp-gmm/parts/mixture/weights/0", json!(0.0), "outside (0, 1]"),
            (
                &tp_gmm,
                "/tp-gmm/parts/mixture/frames/1/2/covariance/0/0",
                json!(-1.0),
                "a covariance is not positive definite",
            ),
            (&promp, "/promp/parts/motions/covariance/0/0", json!(-1.0), "a variance is negative"),
            (&promp, "/promp/parts/gain", json!([[1.0]]), "the gain is not of 15 weights and 4"),
            (&dmp, "/dmp/parts/weights/0/0", json!(2e9), "a value is 2000000000; at most 1e9"),
            (&dmp, "/dmp/parts/weights/1", json!([1.0]), "rows of 5 and of 1 values"),
        ] {
            let error = refused(primitive, pointer, by);
            assert!(error.contains(reason), "{pointer}: {error}");
        }
    }

    #[test]
    fn there_is_no_manner() {
        for primitive in all() {
            let w = task(&[0.3, 0.2, -0.4, 0.1]);
            let mut rng = <rand::rngs::ChaCha8Rng as rand::SeedableRng>::seed_from_u64(1);
            let h = primitive.sample_manner(&mut rng);
            assert_eq!(h.values(), [0.0; 0]);
            assert_eq!(primitive.decode(&w, &h), primitive.generate(&w));
            assert_eq!(primitive.decode(&w, &h).duration_secs, None);
            let error = primitive.manner_space().index("h1").unwrap_err().to_string();
            assert!(error.contains("the primitive has no manner parameters"), "{error}");
        }
    }
}
