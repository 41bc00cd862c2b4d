//! `[scan]` and `[[scan]]`: which scans, to what, how far.

use serde::de::{self, DeserializeSeed, Deserializer, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Serialize, Serializer};
use std::fmt;
use std::marker::PhantomData;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use super::file::{ClusterTable, CollapseTable, RefitTable, ReportTable, RunTable};
use super::quantity::{Count, Length, Ratio};
use super::{Layer, Target};
use crate::write::{Format, is_stdout};

/// The scans of a job file: one table, or a list of them.
#[derive(Debug, Clone, PartialEq)]
pub enum Scans {
    /// `[scan]`
    One(Box<ScanTable>),
    /// `[[scan]]`: each names scans, and says over those before it what of theirs is different.
    Several(Vec<ScanTable>),
}

impl Default for Scans {
    fn default() -> Self {
        Scans::One(Box::default())
    }
}

/// `[scan]`, or one `[[scan]]`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScanTable {
    /// The scans to read: files, folders, or patterns such as `scans/**/*.ply`.
    #[serde(deserialize_with = "one_or_more", serialize_with = "write_one_or_more")]
    pub input: Vec<PathBuf>,
    /// Patterns of what is not meant, though `input` names it.
    #[serde(default, deserialize_with = "one_or_more", serialize_with = "write_one_or_more")]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub exclude: Vec<PathBuf>,
    /// The mesh to write, or a template for it; its extension names the format.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub output: Option<PathBuf>,
    /// The format to write, where the extension does not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub format: Option<Format>,
    /// Whether the result gets what the scan's vertices carry: colours, normals, any other number.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub carry: Option<bool>,
    /// Target: this many faces; several make several meshes.
    #[serde(default, deserialize_with = "one_or_more", serialize_with = "write_one_or_more")]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub faces: Vec<Count>,
    /// Target: this share of the scan's faces; several make several meshes.
    #[serde(default, deserialize_with = "one_or_more", serialize_with = "write_one_or_more")]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub ratio: Vec<Ratio>,
    /// Target: as few faces as keep within this distance of the scan.
    #[serde(default, deserialize_with = "super::quantity::as_written", skip_serializing_if = "Option::is_none")]
    pub max_error: Option<Length>,
    /// What of `[run]` is different for these scans.
    #[serde(default, skip_serializing_if = "is_default")]
    pub run: RunTable,
    /// What of `[cluster]` is.
    #[serde(default, skip_serializing_if = "is_default")]
    pub cluster: ClusterTable,
    /// What of `[collapse]` is.
    #[serde(default, skip_serializing_if = "is_default")]
    pub collapse: CollapseTable,
    /// What of `[refit]` is.
    #[serde(default, skip_serializing_if = "is_default")]
    pub refit: RefitTable,
    /// What of `[report]` is.
    #[serde(default, skip_serializing_if = "is_default")]
    pub report: ReportTable,
}

fn is_default<T: Default + PartialEq>(table: &T) -> bool {
    *table == T::default()
}

impl Scans {
    /// The tables, in order.
    pub fn tables(&self) -> &[ScanTable] {
        match self {
            Scans::One(table) => std::slice::from_ref(&**table),
            Scans::Several(tables) => tables,
        }
    }

    /// The tables, to be changed.
    pub fn tables_mut(&mut self) -> &mut [ScanTable] {
        match self {
            Scans::One(table) => std::slice::from_mut(&mut **table),
            Scans::Several(tables) => tables,
        }
    }
}

impl ScanTable {
    /// What was said of targets, the finest first; at least one.
    pub fn targets(&self) -> std::result::Result<Vec<Target>, String> {
        let mut targets: Vec<Target> = match (&self.faces[..], &self.ratio[..], self.max_error) {
            (faces, [], None) if !faces.is_empty() => faces.iter().map(|Count(n)| Target::Faces(*n)).collect(),
            ([], ratios, None) if !ratios.is_empty() => ratios.iter().map(|Ratio(r)| Target::Ratio(*r)).collect(),
            ([], [], Some(Length(x))) => vec![Target::MaxError(x)],
            ([], [], None) => return Err("no target: say one of faces, ratio and max_error".into()),
            _ => return Err("more than one target: say only one of faces, ratio and max_error".into()),
        };
        targets.sort_by(|a, b| b.fineness().total_cmp(&a.fineness()));
        match targets.windows(2).find(|two| two[0] == two[1]) {
            Some(two) => Err(format!("the target {} is said twice", two[0])),
            None => Ok(targets),
        }
    }

    /// Says something of a target.
    fn says_target(&self) -> bool {
        !self.faces.is_empty() || !self.ratio.is_empty() || self.max_error.is_some()
    }

    fn check(&self) -> std::result::Result<(), String> {
        let empty = |path: &PathBuf| path.as_os_str().is_empty();
        if self.input.is_empty() || self.input.iter().any(empty) {
            return Err("`input` is empty".into());
        }
        if self.output.as_ref().is_some_and(empty) {
            return Err("`output` is empty".into());
        }
        if self.says_target() { self.targets().map(|_| ()) } else { Ok(()) }
    }

    /// Rewrites every path. What is excluded is said in patterns of its own.
    pub fn move_paths(&mut self, to: &dyn Fn(&Path) -> PathBuf) {
        let files = self.input.iter_mut().chain(&mut self.output).filter(|path| !is_stdout(path));
        for path in files.chain(&mut self.run.scratch).chain(&mut self.collapse.lock_vertices) {
            *path = to(path);
        }
    }
}

impl Layer for ScanTable {
    /// Its inputs are its own; a target of any kind goes over one of any other.
    fn over(self, below: Self) -> Self {
        let target = if self.says_target() { &self } else { &below };
        ScanTable {
            faces: target.faces.clone(),
            ratio: target.ratio.clone(),
            max_error: target.max_error,
            output: self.output.or(below.output),
            format: self.format.or(below.format),
            carry: self.carry.or(below.carry),
            run: self.run.over(below.run),
            cluster: self.cluster.over(below.cluster),
            collapse: self.collapse.over(below.collapse),
            refit: self.refit.over(below.refit),
            report: self.report.over(below.report),
            input: self.input,
            exclude: self.exclude,
        }
    }
}

impl Serialize for Scans {
    fn serialize<S: Serializer>(&self, out: S) -> Result<S::Ok, S::Error> {
        match self {
            Scans::One(table) => table.serialize(out),
            Scans::Several(tables) => tables.serialize(out),
        }
    }
}

impl<'de> Deserialize<'de> for Scans {
    fn deserialize<D: Deserializer<'de>>(input: D) -> Result<Self, D::Error> {
        input.deserialize_any(ScansVisitor)
    }
}

struct ScansVisitor;

/// Checked while a table is being read, so that the error points at it.
impl<'de> Visitor<'de> for ScansVisitor {
    type Value = Scans;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a table [scan] or a list of tables [[scan]]")
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<Scans, A::Error> {
        let table = ScanTable::deserialize(de::value::MapAccessDeserializer::new(map))?;
        table.check().and_then(|()| table.targets()).map_err(de::Error::custom)?;
        if table.output.is_none() {
            return Err(de::Error::missing_field("output"));
        }
        Ok(Scans::One(table.into()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut tables: A) -> Result<Scans, A::Error> {
        let mut several = Vec::new();
        while let Some(Checked(table)) = tables.next_element()? {
            several.push(table);
        }
        Ok(Scans::Several(several))
    }
}

struct Checked(ScanTable);

impl<'de> Deserialize<'de> for Checked {
    fn deserialize<D: Deserializer<'de>>(input: D) -> Result<Self, D::Error> {
        let table = ScanTable::deserialize(input)?;
        table.check().map_err(de::Error::custom)?;
        Ok(Checked(table))
    }
}

/// For `deserialize_with`: one value, or a list of them, each as a person would write it.
fn one_or_more<'de, D, T>(input: D) -> Result<Vec<T>, D::Error>
where
    D: Deserializer<'de>,
    T: FromStr<Err: fmt::Display>,
{
    input.deserialize_any(OneOrMore(PhantomData))
}

struct OneOrMore<T>(PhantomData<T>);

impl<T: FromStr<Err: fmt::Display>> OneOrMore<T> {
    fn one<E: de::Error>(text: &str) -> Result<Vec<T>, E> {
        text.parse().map(|value| vec![value]).map_err(E::custom)
    }
}

impl<'de, T: FromStr<Err: fmt::Display>> Visitor<'de> for OneOrMore<T> {
    type Value = Vec<T>;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a number, words in quotes, or a list of them")
    }

    fn visit_str<E: de::Error>(self, text: &str) -> Result<Vec<T>, E> {
        Self::one(text)
    }

    fn visit_i64<E: de::Error>(self, n: i64) -> Result<Vec<T>, E> {
        Self::one(&n.to_string())
    }

    fn visit_u64<E: de::Error>(self, n: u64) -> Result<Vec<T>, E> {
        Self::one(&n.to_string())
    }

    fn visit_f64<E: de::Error>(self, x: f64) -> Result<Vec<T>, E> {
        Self::one(&x.to_string())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Vec<T>, A::Error> {
        let mut values = Vec::new();
        while let Some(more) = list.next_element_seed(OneOrMore(PhantomData))? {
            values.extend(more);
        }
        Ok(values)
    }
}

impl<'de, T: FromStr<Err: fmt::Display>> DeserializeSeed<'de> for OneOrMore<T> {
    type Value = Vec<T>;

    fn deserialize<D: Deserializer<'de>>(self, input: D) -> Result<Vec<T>, D::Error> {
        input.deserialize_any(self)
    }
}

/// For `serialize_with`: one value as itself.
fn write_one_or_more<T: Serialize, S: Serializer>(values: &[T], out: S) -> Result<S::Ok, S::Error> {
    match values {
        [one] => one.serialize(out),
        several => several.serialize(out),
    }
}
