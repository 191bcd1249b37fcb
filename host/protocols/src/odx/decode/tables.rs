//! Tables: a key chooses the row that says what follows.

use super::super::coded::Stop;
use super::super::compu::Physical;
use super::super::model::{Item, KeyName, Link, Model, OdxTable, Param, Row, Target};
use super::{Key, Reader, is_written};

impl<'a> Reader<'a> {
    fn table(&self, link: Link) -> Option<u32> {
        match self.model.links.get(link as usize)? {
            Target::Item(Item::Table(table)) => Some(*table),
            Target::Name(name) => self.view.tables.get(name).copied(),
            _ => None,
        }
    }

    pub(super) fn table_key(&mut self, param: &'a Param, link: Link) -> Result<(), Stop> {
        if let Some(Item::Row(table, row)) = self.model.item(link) {
            self.keys.push((param.name.clone(), Key::Row(table, row)));
            return Ok(());
        }
        let model = self.model;
        let number =
            self.table(link).ok_or_else(|| Stop::not_evaluated("a table that is not in the file"))?;
        let table = &model.tables[number as usize];
        let before = self.values.len();
        self.dop(table.key.ok_or_else(|| Stop::not_evaluated("a table without a type of keys"))?, param.bit)?;
        let [key] = &self.values[before..] else {
            return Err(Stop::not_evaluated("a key of several values"));
        };
        let rows = model.rows(number, table);
        let mut rows = rows.filter(|(_, row)| is_written(&key.value, &row.key));
        let (Some((place, row)), None) = (rows.next(), rows.next()) else {
            return Err(Stop::not_evaluated("a key that no row of the table has, or several"));
        };
        let name = row.name.to_string();
        drop(rows);
        if let Some(shown) = self.values.last_mut() {
            shown.value = Physical::Text(name);
        }
        self.keys.push((param.name.clone(), Key::Row(place.0, place.1)));
        Ok(())
    }

    pub(super) fn table_struct(&mut self, key: &KeyName) -> Result<(), Stop> {
        let Some(Key::Row(table, row)) = self.key(key) else {
            return Err(Stop::not_evaluated("a row that no key before it says"));
        };
        let row = &self.model.tables[table as usize].rows[row as usize];
        match row.content {
            Some(content) => self.inside(&row.name, content),
            None => Ok(()),
        }
    }
}

impl Model {
    /// The rows of a table with their places, those of others among them.
    pub fn rows<'a>(
        &'a self,
        number: u32,
        table: &'a OdxTable,
    ) -> impl Iterator<Item = ((u32, u32), &'a Row)> {
        let own = (0..).zip(&table.rows).map(move |(row, content)| ((number, row), content));
        let shared = table.shared.iter().filter_map(|link| match self.item(*link)? {
            Item::Row(table, row) => Some(((table, row), &self.tables[table as usize].rows[row as usize])),
            _ => None,
        });
        own.chain(shared)
    }
}
