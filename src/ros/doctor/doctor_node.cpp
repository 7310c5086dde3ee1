// SPDX-License-Identifier: Apache-2.0
// `omnister doctor`: looks at a running rig once and prints what is wrong; or, with --watch, goes
// on looking and publishes it as a diagnostic.
#include <diagnostic_msgs/DiagnosticArray.h>
#include <ros/console.h>
#include <ros/ros.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cstdlib>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <utility>

#include "health/diagnostic_pace.h"
#include "omnister/common/error.h"
#include "ros/doctor/doctor_facts.h"
#include "ros/node/logger_service.h"
#include "ros/node/run_node.h"

namespace omnister {
namespace {

constexpr double kMasterPeriod = 0.25;  // [s] between questions to the master

bool healthy(const std::vector<Finding>& findings) {
  for (const Finding& finding : findings)
    if (finding.severity != Finding::Severity::kNote) return false;
  return true;
}

void printJson(const DoctorFacts& facts, const std::vector<Finding>& findings) {
  nlohmann::ordered_json result;
  result["healthy"] = healthy(findings);
  result["cause"] = healthy(findings) ? nullptr : nlohmann::ordered_json(findings.front().code);
  result["findings"] = nlohmann::ordered_json::array();
  for (const Finding& finding : findings)
    result["findings"].push_back({{"code", finding.code},
                                  {"severity", severityName(finding.severity)},
                                  {"cause", finding.cause},
                                  {"mend", finding.mend}});
  result["stereo_node"] = facts.stereo.node;
  result["clouds"] = facts.stereo.clouds;
  result["valid_fraction"] = facts.stereo.valid_fraction;
  result["images"] = nlohmann::ordered_json::array();
  for (const auto& images : facts.images)
    result["images"].push_back({{"topic", images.topic},
                                {"received", images.received.value_or(0)},
                                {"rate_hz", images.rate},
                                {"width", images.width},
                                {"height", images.height}});
  std::cout << result.dump(-1, ' ', false, nlohmann::ordered_json::error_handler_t::replace)
            << std::endl;
}

void printText(const DoctorFacts& facts, const std::vector<Finding>& findings) {
  for (const Finding& finding : findings)
    std::cout << severityName(finding.severity) << " [" << finding.code << "]: " << finding.cause
              << "\n  mend: " << finding.mend << "\n";
  if (!healthy(findings)) return;
  std::cout << "healthy: " << facts.stereo.clouds << " clouds from " << facts.stereo.node << ", "
            << static_cast<int>(100.0 * facts.stereo.valid_fraction) << " % of the pixels valid"
            << std::endl;
}

/// Long after the start: the master may have gone, or been started anew.
DoctorFacts masterFacts() {
  DoctorFacts facts;
  facts.master_uri = ros::master::getURI();
  facts.master = answers(facts.master_uri) && ros::master::check();
  ros::V_string nodes;
  facts.registered =
      !facts.master || !ros::master::getNodes(nodes) ||
      std::find(nodes.begin(), nodes.end(), ros::this_node::getName()) != nodes.end();
  return facts;
}

bool masterKnowsUs() {
  const DoctorFacts facts = masterFacts();
  return facts.master && facts.registered;
}

DoctorFacts look(const DoctorOptions& options) {
  const DoctorFacts facts = masterFacts();
  return facts.master && facts.registered ? gatherFacts(options) : facts;
}

void watch(DoctorOptions options, double period) {
  ros::NodeHandle node;
  DiagnosticPace pace(kMasterPeriod);
  bool known = true;
  // That the master went is told at once.
  options.interrupt = [&] { return known && pace.due() && !masterKnowsUs(); };
  ros::Publisher publisher = node.advertise<diagnostic_msgs::DiagnosticArray>("/diagnostics", 10);
  while (ros::ok()) {
    const std::vector<Finding> findings = diagnose(look(options));
    const bool knew = std::exchange(known, masterKnowsUs());
    if (knew && !known) continue;
    diagnostic_msgs::DiagnosticArray message;
    message.header.stamp = ros::Time::now();
    diagnostic_msgs::DiagnosticStatus status;
    status.name = ros::this_node::getName().substr(1) + ": doctor";
    status.hardware_id = "none";
    status.level = findings.empty() || findings.front().severity == Finding::Severity::kNote
                       ? diagnostic_msgs::DiagnosticStatus::OK
                   : findings.front().severity == Finding::Severity::kWarning
                       ? diagnostic_msgs::DiagnosticStatus::WARN
                       : diagnostic_msgs::DiagnosticStatus::ERROR;
    status.message = findings.empty() ? "healthy" : findings.front().cause;
    for (const Finding& finding : findings) {
      diagnostic_msgs::KeyValue value;
      value.key = finding.code;
      value.value = finding.cause + ". Mend: " + finding.mend;
      status.values.push_back(value);
    }
    message.status.push_back(status);
    publisher.publish(message);
    const ros::SteadyTime start = ros::SteadyTime::now();
    while (ros::ok() && (ros::SteadyTime::now() - start).toSec() < period && !options.interrupt())
      ros::WallDuration(std::min(kMasterPeriod, period)).sleep();
  }
}

int run(int argc, char** argv) {
  CLI::App app("Looks at a running rig and says what is wrong", "doctor_node");
  DoctorOptions options;
  bool json = false, keep_watching = false;
  double period = 5.0;
  app.add_option("--camera", options.camera, "Namespace of the camera; empty: the first found");
  app.add_option("--seconds", options.seconds, "To listen at most [s]")
      ->check(CLI::Range(0.1, 600.0));
  app.add_flag("--json", json, "Print one JSON object");
  app.add_flag("--watch", keep_watching,
               "Go on, and publish a diagnostic; listens to no image or cloud");
  app.add_option("--period", period, "Of --watch, between looks [s]")
      ->check(CLI::Range(0.1, 3600.0));
  // roslaunch adds __name:=… and the like.
  std::vector<std::string> words;
  ros::removeROSArgs(argc, argv, words);
  std::vector<std::string> arguments(words.rbegin(), words.rend() - 1);
  try {
    app.parse(arguments);
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? 0 : 2;
  }
  ::setenv("ROS_MASTER_URI", "http://localhost:11311", 0);
  const std::uint32_t kind =
      keep_watching ? 0 : ros::init_options::AnonymousName | ros::init_options::NoRosout;
  if (!initNode(argc, argv, "doctor", kind)) return 1;
  endBySignals();
  // Its own words are its findings.
  if (ros::console::set_logger_level(ROSCONSOLE_DEFAULT_NAME, ros::console::levels::Fatal))
    ros::console::notifyLoggerLevelsChanged();
  DoctorFacts facts = machineFacts();
  facts.master = answers(ros::master::getURI()) && ros::master::check();
  facts.master_uri = ros::master::getURI();
  if (facts.master) {
    ros::AsyncSpinner spinner(2);
    spinner.start();
    const std::shared_ptr<LoggerService> loggers = LoggerService::shared();
    options.passive = keep_watching;
    if (keep_watching) {
      watch(options, period);
      return 0;
    }
    facts = gatherFacts(options);
  }
  const std::vector<Finding> findings = diagnose(facts);
  if (json)
    printJson(facts, findings);
  else
    printText(facts, findings);
  if (!std::cout.flush()) throw Error("cannot write to standard output");
  return 0;
}

}  // namespace
}  // namespace omnister

int main(int argc, char** argv) {
  try {
    return omnister::run(argc, argv);
  } catch (const std::exception& error) {
    std::cerr << "omnister: " << omnister::printable(error.what(), 1000) << '\n';
    return 1;
  }
}
