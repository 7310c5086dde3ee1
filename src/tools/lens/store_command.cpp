// SPDX-License-Identifier: Apache-2.0
#include <memory>
#include <optional>

#include "omnister/common/error.h"
#include "omnister/lens/lens_store.h"
#include "tools/cli/commands.h"

namespace omnister::tools {
namespace {

using Json = nlohmann::ordered_json;

struct StoreArguments {
  std::string folder;
  std::string name;
  int version = 0;
};

Json describeVersion(const StoredLens& stored) {
  Json out = {{"version", stored.version}, {"current", stored.current}};
  if (!stored.file) {
    out["problem"] = stored.problem;
    return out;
  }
  const CalibrationRecord& record = stored.file->calibration;
  out["model"] = stored.file->lens->model();
  out["rms_px"] = record.rms_px ? Json(*record.rms_px) : Json(nullptr);
  out["date"] = record.date;
  return out;
}

void listVersions(const StoreArguments& arguments, bool json) {
  const LensStore store(arguments.folder);
  std::vector<std::string> names = store.names();
  if (!arguments.name.empty()) names = {arguments.name};
  Json result = Json::object();
  for (const std::string& name : names) {
    const std::vector<StoredLens> versions = store.versions(name);
    if (versions.empty() && !arguments.name.empty())
      throw InputError(store.folder().string(), name, "is not stored here");
    for (const StoredLens& stored : versions) {
      if (json)
        result[name].push_back(describeVersion(stored));
      else
        printResult(false, {{name, describe(stored)}});
    }
  }
  if (json) printResult(true, result);
  if (names.empty()) say("nothing is stored in " + store.folder().string());
}

void rollBack(const StoreArguments& arguments, bool json) {
  const StoredLens stored =
      LensStore(arguments.folder)
          .rollBack(arguments.name,
                    arguments.version == 0 ? std::nullopt : std::optional(arguments.version));
  printResult(json, describeVersion(stored));
}

}  // namespace

void addStore(CLI::App& app) {
  CLI::App* command = app.add_subcommand(
      "store", "The calibrations that nodes keep, and the way back to earlier ones");
  command->require_subcommand(1);
  const auto arguments = std::make_shared<StoreArguments>();
  const auto add = [&](const char* name, const char* help) {
    CLI::App* sub = command->add_subcommand(name, help);
    sub->add_option("--store", arguments->folder,
                    "Folder; default: $ROS_HOME/omnister or ~/.ros/omnister")
        ->type_name("DIR");
    return sub;
  };
  CLI::App* list = add("list", "Every kept version, newest first");
  list->add_option("NAME", arguments->name, "Of a camera; default: all");
  const bool& list_json = addJsonFlag(*list);
  list->callback([arguments, &list_json] { listVersions(*arguments, list_json); });
  CLI::App* back =
      add("rollback", "Make an earlier version the current one; nothing is lost by it");
  back->add_option("NAME", arguments->name, "Of a camera")->required();
  back->add_option("--version", arguments->version,
                   "Version; default: the newest good one older than the current one")
      ->check(CLI::Range(1, 999999999));
  const bool& back_json = addJsonFlag(*back);
  back->callback([arguments, &back_json] { rollBack(*arguments, back_json); });
}

}  // namespace omnister::tools
