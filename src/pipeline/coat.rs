//! What corners and faces of the scan carry, on its way to the result.

use super::{Intermediate, Run};
use crate::carry::{Steer, Worn, least_position_bytes, mean_shades, put_on, range_length, shades, vote, votes_bytes};
use crate::collapse::{Carried, Policies};
use crate::error::Result;
use crate::mesh::coat::Dress;
use crate::mesh::columns::{self, Column, Columns, Meaning};
use crate::mesh::{Coordinate, Frame, IndexedMesh, Shades, Wedges};
use crate::read::{Crew, Scan};
use crate::write::{self, Clothes, Wardrobe};
use std::path::Path;

/// Columns of vertices that steer: of the colour and of the normal, if they are there and have any weight.
pub(super) fn steering(policies: &Policies, scan: &Scan) -> Vec<usize> {
    let find = |weight: f64, part: fn(usize) -> Meaning| {
        (weight > 0.0).then(|| columns::find::<3>(scan.columns(), part)).flatten()
    };
    let found = [find(policies.colour_weight, Meaning::Colour), find(policies.normal_weight, Meaning::Normal)];
    found.into_iter().flatten().flatten().collect()
}

/// What a scan wears while it is reduced.
pub(super) struct Outfit<S> {
    pub(super) worn: Worn<S>,
    pub(super) wardrobe: Wardrobe,
    /// Files that its materials name, and that are not there.
    missing: Vec<String>,
}

impl<S: Coordinate> Outfit<S> {
    /// Whether a format says what it is made of.
    fn has_textures_in(&self, format: write::Format) -> bool {
        format.holds_materials() || format.is_ply() && self.wardrobe.as_ply(&self.worn.coat).is_some()
    }
}

/// What a finished mesh wears.
pub(super) struct Dressed<'a> {
    dress: Dress,
    coat: &'a crate::mesh::coat::Coat,
    wardrobe: &'a Wardrobe,
    scan: &'a Path,
}

impl Dressed<'_> {
    /// The vertices that a file of this format gets, of a mesh that has so many.
    pub(super) fn vertices(&self, format: write::Format, of_mesh: usize) -> usize {
        let apart = format != write::Format::Obj && self.dress.splits(format == write::Format::Stl);
        if apart { self.dress.vertices.len() } else { of_mesh }
    }

    pub(super) fn clothes(&self) -> (Clothes<'_>, &Path) {
        (Clothes { dress: &self.dress, coat: self.coat, wardrobe: self.wardrobe }, self.scan)
    }
}

impl Run<'_> {
    fn steering(&self) -> Vec<usize> {
        if self.job.carry { steering(&self.job.policies, self.scan) } else { Vec::new() }
    }

    /// What steers, where the full range of what has a weight of 1 is worth this length.
    fn steers(&self, length: f64) -> Vec<Steer> {
        let weight = |column: usize| match self.scan.columns()[column].meaning {
            Meaning::Normal(_) => self.job.policies.normal_weight,
            _ => self.job.policies.colour_weight,
        };
        self.steering().into_iter().map(|column| Steer { column, length: weight(column) * length }).collect()
    }

    /// What a loaded scan carries into the collapse, and what it wears.
    pub(super) fn outfitted<S: Coordinate>(
        &self,
        mesh: &IndexedMesh<S>,
        frame: Frame,
        asked: Option<u64>,
    ) -> Result<(Option<Carried>, Option<Outfit<S>>)> {
        let crew = Crew { workers: self.purse.workers, progress: self.progress };
        let policies = &self.job.policies;
        let worn = if self.job.carry { put_on(self.scan, mesh, frame, asked, &crew)? } else { None };
        if self.steering().is_empty() && worn.is_none() {
            return Ok((None, None));
        }
        let length = range_length(mesh, asked);
        let mut carried = Carried::default();
        let steers = self.steers(length);
        if !steers.is_empty() {
            carried.shades = shades(self.scan, &steers, mesh, frame, &crew)?;
        }
        let Some((worn, wedges)) = worn else { return Ok((Some(carried), None)) };
        let lengths = [policies.texture_weight, policies.normal_weight].map(|weight| weight * length);
        carried.shades = worn.shades(&wedges, &mesh.faces, &carried.shades, lengths);
        carried.wedges = wedges;
        let (wardrobe, missing) = Wardrobe::of(&worn.coat, self.scan.path());
        Ok((Some(carried), Some(Outfit { worn, wardrobe, missing })))
    }

    /// What a full range of a number that steers is worth, for the result and for each coarser one after it: none where
    /// nothing steers them.
    pub(super) fn lengths<S: Coordinate>(
        &self,
        mesh: &IndexedMesh<S>,
        carried: Option<&Carried>,
        asked: Option<u64>,
    ) -> Vec<f64> {
        let coarser = &self.job.coarser;
        if coarser.is_empty() || carried.is_none_or(|carried| carried.shades.is_empty()) {
            return Vec::new();
        }
        let levels = coarser.iter().map(|level| level.target.faces(self.scan.triangle_count()));
        std::iter::once(asked).chain(levels).map(|asked| range_length(mesh, asked)).collect()
    }

    /// What clustering's result is to be steered by.
    pub(super) fn mean_shades<S: Coordinate>(
        &self,
        mesh: &IndexedMesh<S>,
        frame: Frame,
        asked: Option<u64>,
    ) -> Result<Shades> {
        if self.steering().is_empty() {
            return Ok(Shades::default());
        }
        let crew = Crew { workers: self.purse.workers, progress: self.progress };
        mean_shades(self.scan, &self.steers(range_length(mesh, asked)), mesh, frame, &crew)
    }

    /// What the result wears, in a format that holds any of it.
    pub(super) fn dressed<'o, S: Coordinate>(
        &'o self,
        outfit: Option<&'o Outfit<S>>,
        mesh: &IndexedMesh<S>,
        wedges: &Wedges,
        format: write::Format,
    ) -> Result<Option<Dressed<'o>>> {
        let Some(Outfit { worn, wardrobe, .. }) = outfit.filter(|o| wears(format, o)) else {
            return Ok(None);
        };
        let dress = worn.dress(mesh, wedges, self.progress)?;
        Ok(Some(Dressed { dress, coat: &worn.coat, wardrobe, scan: self.scan.path() }))
    }

    /// What the result's faces carry that has no borders that were held, where the budget has room to find out.
    pub(super) fn voted<S: Coordinate>(
        &self,
        format: write::Format,
        outfit: Option<&Outfit<S>>,
        mesh: &IndexedMesh<S>,
        frame: Frame,
    ) -> Result<Columns> {
        let all = if self.job.carry { self.scan.face_columns() } else { Vec::new() };
        let held = |column: &Column| {
            let labels = outfit.map_or(&[][..], |outfit| &outfit.worn.coat.face_columns);
            labels.iter().any(|c| c.name == column.name)
        };
        let wanted: Vec<usize> = (0..all.len()).filter(|c| !held(&all[*c])).collect();
        let columns: Vec<Column> = wanted.iter().map(|c| all[*c].clone()).collect();
        let Some(least) = least_position_bytes(self.scan) else { return Ok(Columns::default()) };
        if columns.is_empty() || !format.holds_labels(&columns) {
            return Ok(Columns::default());
        }
        let (faces, vertices) = (mesh.faces.len() as u64, mesh.positions.len() as u64);
        let result = 12 * faces + 3 * size_of::<S>() as u64 * vertices;
        let worn = outfit.map_or(0, |outfit| outfit.worn.bytes());
        let taken = result + worn + votes_bytes(faces, columns.len() as u64);
        let positions = self.purse.while_streaming().saturating_sub(taken);
        if positions < least {
            return Ok(Columns::default());
        }
        vote(self.scan, &wanted, mesh, frame, &super::read_crew(&self.purse, self.progress), (&self.scratch, positions))
    }

    /// Which of the scan's columns the result gets, and what of all that the scan carries it does not get.
    pub(super) fn columns<S: Coordinate>(
        &self,
        format: write::Format,
        outfit: Option<&Outfit<S>>,
        voted: &Columns,
    ) -> (Vec<usize>, Vec<String>) {
        use crate::read::Carrier;
        if !self.job.carry {
            return (Vec::new(), Vec::new());
        }
        let columns = self.scan.columns();
        let wanted: Vec<usize> = (0..columns.len()).filter(|c| format.holds(columns[*c].meaning)).collect();
        let is_carried = |name: &str| wanted.iter().any(|c| columns[*c].name == name);
        let is_worn = |meaning: Meaning| {
            let worn = outfit.is_some_and(|outfit| outfit.worn.columns().iter().any(|c| c.meaning == meaning));
            worn && format.holds_at_corners(meaning)
        };
        let mut lost: Vec<String> = Vec::new();
        for attribute in self.scan.attributes() {
            let held = match (attribute.carrier, attribute.name.as_str()) {
                // What OBJ calls one attribute is columns here.
                (Carrier::Vertex, "colour" | "COLOR_0") => !wanted.is_empty(),
                (Carrier::Vertex, "TEXCOORD_0") => is_worn(Meaning::Texture(0)),
                (Carrier::Vertex, "NORMAL") => is_worn(Meaning::Normal(0)),
                (Carrier::Vertex, "s" | "t" | "u" | "v" | "texture_u" | "texture_v" | "tx" | "ty")
                    if is_worn(Meaning::Texture(0)) =>
                {
                    true
                }
                (Carrier::Vertex, name) => is_carried(name),
                (Carrier::Corner, "vt") => is_worn(Meaning::Texture(0)),
                (Carrier::Corner, "vn") => is_worn(Meaning::Normal(0)),
                (Carrier::Face, "usemtl" | "material" | "TextureFile") => {
                    outfit.is_some_and(|o| o.has_textures_in(format))
                }
                (Carrier::Face, "g" | "node") => outfit.is_some() && format.holds_groups(),
                (_, "texcoord") => is_worn(Meaning::Texture(0)),
                (Carrier::Face, name) if voted.columns.iter().any(|c| c.name == name) => true,
                (Carrier::Face, name) => outfit.is_some_and(|outfit| {
                    let coat = &outfit.worn.coat;
                    format.holds_labels(&coat.face_columns) && coat.face_columns.iter().any(|c| c.name == name)
                }),
                _ => false,
            };
            if !(held || lost.contains(&attribute.name)) {
                lost.push(attribute.name);
            }
        }
        if let Some(outfit) = outfit.filter(|outfit| outfit.has_textures_in(format)) {
            lost.extend(outfit.missing.iter().cloned());
            let textures = outfit.wardrobe.textures.iter();
            let kept =
                |texture: &&write::Texture| format == write::Format::Obj || format.is_ply() || texture.mime().is_some();
            lost.extend(textures.filter(|texture| !kept(texture)).map(|texture| texture.name.clone()));
        }
        (wanted, lost)
    }

    /// Whether any of what was lost breaks off at seams, and would be there in core.
    pub(super) fn left_seams_out(&self, format: write::Format, lost: &[String]) -> bool {
        const OF_CORNERS: [&str; 16] = [
            "vt",
            "vn",
            "TEXCOORD_0",
            "NORMAL",
            "texcoord",
            "s",
            "t",
            "u",
            "v",
            "texture_u",
            "texture_v",
            "tx",
            "ty",
            "usemtl",
            "material",
            "TextureFile",
        ];
        let held = format != write::Format::Stl && self.scan.has_coat();
        held && lost.iter().any(|name| OF_CORNERS.contains(&name.as_str()))
    }

    /// The loaded scan, ready to be collapsed.
    pub(super) fn loaded<S: Coordinate>(
        &self,
        (mesh, frame, mut report): crate::read::Loaded<S>,
        asked: Option<u64>,
    ) -> Result<Intermediate<S>> {
        let (carried, outfit) = self.outfitted(&mesh, frame, asked)?;
        // A format without corners of its own has a vertex for each side of a seam: none of these is one too many.
        let wedges = outfit.as_ref().map_or(0, |outfit| outfit.worn.wedges());
        let sides = wedges.saturating_sub(mesh.positions.len()) as u64;
        report.duplicate_vertices = report.duplicate_vertices.saturating_sub(sides);
        Ok(Intermediate { mesh, frame, carried, outfit, samples: None, source: super::Source::Loaded(report) })
    }
}

/// Whether a format holds any of what corners and faces carry.
fn wears<S: Coordinate>(format: write::Format, outfit: &Outfit<S>) -> bool {
    format != write::Format::Stl || format.holds_labels(&outfit.worn.coat.face_columns)
}
