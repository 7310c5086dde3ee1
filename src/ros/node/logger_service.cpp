// SPDX-License-Identifier: Apache-2.0
#include "ros/node/logger_service.h"

#include <log4cxx/logger.h>
#include <log4cxx/logmanager.h>
#include <ros/names.h>
#include <ros/service_manager.h>
#include <roscpp/GetLoggers.h>

#include <mutex>

namespace omnister {
namespace {

/// In the words of rosconsole's own answer.
std::string levelName(int level) {
  using log4cxx::Level;
  if (level <= Level::DEBUG_INT) return "debug";
  if (level <= Level::INFO_INT) return "info";
  if (level <= Level::WARN_INT) return "warn";
  return level <= Level::ERROR_INT ? "error" : "fatal";
}

bool answer(roscpp::GetLoggers::Request&, roscpp::GetLoggers::Response& response) {
  for (const log4cxx::LoggerPtr& logger : log4cxx::LogManager::getCurrentLoggers()) {
    roscpp::Logger entry;
    entry.name = logger->getName();
    entry.level = levelName(logger->getEffectiveLevel()->toInt());
    response.loggers.push_back(entry);
  }
  return true;
}

}  // namespace

std::shared_ptr<LoggerService> LoggerService::shared() {
  static std::mutex mutex;
  static std::weak_ptr<LoggerService> known;
  const std::lock_guard<std::mutex> lock(mutex);
  std::shared_ptr<LoggerService> service = known.lock();
  if (!service) known = service = std::make_shared<LoggerService>();
  return service;
}

LoggerService::LoggerService() {
  const std::string name = ros::names::resolve("~get_loggers");
  ros::ServiceManager::instance()->unadvertiseService(name);
  ros::NodeHandle node = callbacks_.on(ros::NodeHandle());
  server_ = node.advertiseService(name, answer);
  callbacks_.start();
}

}  // namespace omnister
